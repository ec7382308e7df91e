"""While a run goes on, Python looks for garbage among new objects alone."""

import gc

from factorgraph_loc.experiments.causal_run import GARBAGE_THRESHOLD, only_new_searched


def test_what_was_there_is_not_searched_for_the_time_being():
    before = gc.get_threshold(), list(gc.callbacks)
    assert gc.get_freeze_count() == 0
    with only_new_searched():
        assert gc.get_freeze_count() > 10_000  # of the modules
        with only_new_searched():  # as a run within a run
            pass
        assert gc.get_freeze_count() > 10_000
    assert gc.get_freeze_count() == 0
    assert (gc.get_threshold(), gc.callbacks) == before


def test_what_stays_is_searched_twice_and_never_again():
    with only_new_searched():
        before, searches = gc.get_freeze_count(), gc.get_stats()[2]["collections"]
        kept = [
            [i] for i in range(50 * GARBAGE_THRESHOLD)
        ]  # fifty searches of new objects, five of those that outlived one
        assert gc.get_freeze_count() > before + 30 * GARBAGE_THRESHOLD
        assert gc.get_stats()[2]["collections"] == searches
    assert len(kept) == 50 * GARBAGE_THRESHOLD

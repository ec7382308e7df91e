"""While a run goes on, Python looks for garbage among new objects alone."""

import gc

from factorgraph_loc.experiments.garbage import only_new_searched


def test_what_was_there_is_not_searched_for_the_time_being():
    assert gc.get_freeze_count() == 0
    with only_new_searched():
        assert gc.get_freeze_count() > 10_000  # of the modules
        with only_new_searched():  # as a run within a run
            pass
        assert gc.get_freeze_count() > 10_000
    assert gc.get_freeze_count() == 0

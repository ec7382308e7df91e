"""The states of tags: the evidence of scans on them, and how it is taken back."""

import numpy as np
import pytest

from factors.rfid.tag_states import FARTHEST, MOST_MOVED, PITCH, WEAKNESSES, TagStates, displacements, hypotheses

PLACES, WEAK = len(displacements()), len(WEAKNESSES)
TAG = np.zeros(1, dtype=np.int64)


def told(surveyed: float, weak: float = 0.0, *moved: float) -> np.ndarray:
    """Log-likelihoods (1, S): as surveyed, weak, and at the first places; elsewhere as out of reach."""
    out = np.zeros((1, 1 + WEAK + PLACES))
    out[0, 0], out[0, 1 : 1 + WEAK], out[0, 1 + WEAK : 1 + WEAK + len(moved)] = surveyed, weak, moved
    return out


def test_displacements_are_a_disc_around_the_surveyed_place() -> None:
    places = displacements()
    assert np.hypot(*places.T).min() == pytest.approx(PITCH)
    assert np.hypot(*places.T).max() == pytest.approx(FARTHEST)
    assert places.sum(axis=0) == pytest.approx((0.0, 0.0))
    assert len(np.unique(places, axis=0)) == len(places) == 28


def test_weak_tags_are_at_the_place_of_the_map_and_moved_ones_as_strong_as_others() -> None:
    states = hypotheses()
    assert not states[0].any()
    assert not states[: 1 + WEAK, :2].any()
    assert not states[1 + WEAK :, 2:].any()
    assert WEAKNESSES[:, 2].sum() == pytest.approx(1.0)


def test_scans_add_up_by_the_rule_of_bayes() -> None:
    states = TagStates(2, 0.03, 0.02, 0.05)
    assert np.exp(states.odds) == pytest.approx(np.full(2, 0.1 / 0.9))
    for t in range(3):
        states.learn(float(t), TAG, told(-2.0, -0.5, -1.0))
    other = 0.03 + 0.02 * np.exp(-1.5) + 0.05 / PLACES * (PLACES - 1 + np.exp(-3.0))
    assert np.exp(states.odds) == pytest.approx((other / (0.9 * np.exp(-6.0)), 0.1 / 0.9), rel=1e-6)
    assert states.doubtful.tolist() == [0]
    moved = 0.05 / PLACES * (PLACES - 1 + np.exp(-3.0)) / (other + 0.9 * np.exp(-6.0))
    assert states.suspects["moved"] == {0: pytest.approx(moved, rel=1e-6)}


def test_a_tag_that_is_read_less_is_weak_and_not_moved() -> None:
    states = TagStates(1, 0.03, 0.03, 0.03)
    states.hear(1.0, TAG)
    states.learn(1.0, TAG, told(-8.0, -1.0, *np.full(PLACES, -3.0)))
    assert list(states.suspects["weak"]) == [0]
    assert not states.suspects["moved"]


def test_a_tag_that_was_read_is_not_dead_but_may_be_weak_or_have_moved() -> None:
    states = TagStates(1, 0.3, 0.05, 0.15)
    assert not states.were_read(TAG)[0]
    states.hear(4.0, TAG)
    assert states.were_read(TAG)[0]
    assert states.last_read == 4.0
    assert np.exp(states.odds) == pytest.approx(0.2 / 0.5)
    states.learn(4.0, TAG, told(-7.0, -7.0, -1.0))
    assert list(states.suspects["moved"]) == [0]


def test_the_odds_change_by_the_expected_log_likelihood_of_other_states() -> None:
    states, rng = TagStates(1, 0.03, 0.03, 0.1), np.random.default_rng(1)
    for t in range(5):
        scan, before = rng.normal(size=told(0.0).shape), states.odds.copy()
        expected = states.expect(TAG, scan)
        states.learn(float(t), TAG, scan)
        assert states.odds == pytest.approx(before + expected - scan[:, 0], abs=1e-6)


@pytest.mark.parametrize(("read", "expected"), [(False, 0.0), (True, -np.inf)])
def test_where_no_tag_is_weak_or_moves_a_tag_that_was_read_is_as_surveyed(read: bool, expected: float) -> None:
    states = TagStates(1, 0.1, 0.0, 0.0)
    if read:
        states.hear(0.0, TAG)
    assert states.expect(TAG, told(-3.0, -1.0)) == expected
    states.learn(0.0, TAG, told(-3.0, -1.0))
    assert states.odds == pytest.approx(-np.inf if read else np.log(0.1 / 0.9) + 3.0)


def test_evidence_is_taken_back_and_reads_are_not() -> None:
    states = TagStates(2, 0.1, 0.0, 0.1)
    both = np.arange(2)
    states.learn(1.0, both, np.concatenate((told(-1.0), told(-1.0, 0.0, -0.5))))
    before = states.odds.copy()
    states.learn(2.0, both, np.concatenate((told(-3.0), told(-3.0))))
    states.hear(2.5, both[1:])
    states.learn(3.0, TAG, told(-4.0))
    states.forget(2.0)
    assert states.odds[0] == pytest.approx(before[0])
    assert states.odds[1] < before[1]
    states.learn(2.0, TAG, told(-3.0))  # it comes again, and counts once
    assert states.odds[0] == pytest.approx(before[0] + 3.0)


def test_where_all_tags_are_as_surveyed_none_is_doubtful() -> None:
    states = TagStates(1, 0.0, 0.0, 0.0)
    states.learn(1.0, TAG, told(-1e3))
    assert states.odds == -np.inf
    assert not states.doubtful.size
    assert states.were_read(TAG)[0]


def test_memory_is_bounded() -> None:
    states = TagStates(1, 0.1, 0.0, 0.0)
    for i in range(10_000):
        states.learn(0.1 * i, TAG, told(-0.1))
    states.forget(-np.inf)
    # evidence that is older than 200 s is not taken back
    assert states.odds[0] == pytest.approx(np.log(0.1 / 0.9) + 0.1 * (10_000 - 2000), abs=1.0)


def test_the_more_tags_have_moved_the_likelier_it_is_of_others() -> None:
    """Three of ten tags that were read are found to have moved: by a beta prior that is worth twenty the share is 0.12. What was
    learnt is taken back, and the share with it."""
    states = TagStates(30, 0.02, 0.0, 0.03)
    before = states.prior
    states.hear(1.0, np.arange(10))
    after = states.odds.copy()
    for tag in range(3):
        states.learn(2.0, np.array((tag,)), told(-20.0, -20.0, 5.0))
    share = (20.0 * 0.03 + 3.0) / 30.0
    assert states.odds[5] == pytest.approx(np.log(share / 0.95))
    assert states.odds[-1] == pytest.approx(np.log((0.02 + share) / 0.95))
    assert states.prior == pytest.approx(states.odds[-1])
    states.forget(2.0)
    assert states.odds == pytest.approx(after)
    assert states.prior == pytest.approx(before)


def test_the_order_of_evidence_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    tags, moved = np.arange(12), told(-9.0, -9.0, 1.0)
    events = [(tag, moved if tag < 4 else rng.normal(0.0, 0.3, (1, 1 + WEAK + PLACES))) for tag in tags.tolist()]
    odds = []
    for order in (events, events[::-1], [events[i] for i in rng.permutation(12)]):
        states = TagStates(14, 0.03, 0.03, 0.03)
        for tag, evidence in order:
            states.hear(1.0, np.array((tag,)))
            states.learn(1.0, np.array((tag,)), evidence)
        odds.append((states.odds, states.prior))
    assert odds[0][1] > TagStates(14, 0.03, 0.03, 0.03).prior + 0.5
    for other, prior in odds[1:]:
        assert other == pytest.approx(odds[0][0], abs=1e-4)
        assert prior == pytest.approx(odds[0][1])


def test_the_share_of_moved_tags_has_a_limit() -> None:
    states = TagStates(30, 0.02, 0.0, 0.03)
    states.hear(1.0, np.arange(30))
    for tag in range(29):
        states.learn(2.0, np.array((tag,)), told(-20.0, -20.0, 5.0))
    assert states.odds[-1] == pytest.approx(np.log(MOST_MOVED / 0.95))

"""The states of tags: what reads and silences tell, and what is taken back."""

import numpy as np
import pytest

from factors.rfid.tag_states import TagStates, log_odds


def test_silences_add_up_and_one_read_revives() -> None:
    states = TagStates(3, 0.03)
    assert states.dead == pytest.approx(np.full(3, 0.03))
    for t in range(4):
        states.miss(float(t), np.array((2.0, 0.1, 0.0)))
    # Bayes' rule by hand: an alive tag is silent with exp(-2) each time
    assert states.dead[0] == pytest.approx(0.03 / (0.03 + 0.97 * np.exp(-8.0)))
    assert states.dead[1] == pytest.approx(0.03 / (0.03 + 0.97 * np.exp(-0.4)))
    assert states.dead[2] == pytest.approx(0.03)
    assert states.believed_dead.tolist() == [0]
    states.hear(4.0, np.array((0,)))
    assert states.dead[0] == 0.0
    states.miss(5.0, np.array((2.0, 0.0, 0.0)))
    assert states.odds[0] == -np.inf
    assert states.heard == 4.0


def test_silences_are_taken_back_and_reads_are_not() -> None:
    states = TagStates(2, 0.1)
    states.miss(1.0, np.array((1.0, 1.0)))
    before = states.odds
    states.miss(2.0, np.array((3.0, 3.0)))
    states.hear(2.5, np.array((1,)))
    states.miss(3.0, np.array((4.0, 0.0)))
    states.forget(2.0)
    assert states.odds == pytest.approx((before[0], -np.inf))
    states.miss(2.0, np.array((3.0, 0.0)))  # it comes again, and counts once
    assert states.odds[0] == pytest.approx(before[0] + 3.0)


def test_where_no_tag_is_dead_none_is_given_up() -> None:
    states = TagStates(1, 0.0)
    states.miss(1.0, np.array((1e3,)))
    assert states.dead[0] == 0.0
    assert log_odds(0.0) == -np.inf


def test_memory_is_bounded() -> None:
    states = TagStates(1, 0.1)
    for i in range(10_000):
        states.miss(0.1 * i, np.array((0.1,)))
    states.forget(-np.inf)
    # what is older than is kept is not taken back
    assert states.odds[0] == pytest.approx(log_odds(0.1) + 0.1 * (10_000 - 2000), abs=1.0)

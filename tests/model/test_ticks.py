"""When there are ticks."""

import numpy as np
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.scoring import Ticks, check_tick_gap


def fired(start, stamps, gap=60.0):
    ticks = Ticks(start, gap)
    found = [tick for t in stamps for tick in ticks.advance(t)]
    return [*found, *ticks.rest()], ticks


def grid(start, last):
    return (start + np.arange(np.floor((last - start) * 10 + 1e-6) + 1) / 10).tolist()


@pytest.mark.parametrize("start", [0.0, 0.1234, 1.7e9 + 0.3])
def test_they_stand_on_a_grid_across_gaps_that_are_short_enough(start):
    stamps = start + np.cumsum(np.random.default_rng(1).uniform(0.0, 1.0, 300)) + np.repeat((0.0, 59.0), 150)
    found, ticks = fired(start, stamps.tolist())
    assert found == grid(start, stamps[-1])
    assert ticks.seconds == pytest.approx(stamps[-1] - start)
    assert not ticks.skipped


def test_there_are_none_inside_a_gap_that_is_too_long():
    stamps = [0.0, 0.25, 0.5, 60.77, 61.0]
    found, ticks = fired(0.0, stamps)
    assert found == [t for t in grid(0.0, 61.0) if t <= 0.5 or t >= 60.77]
    assert ticks.skipped == [(0.5, 60.77)]
    assert ticks.seconds == pytest.approx(61.0 - 60.27)
    assert fired(0.0, stamps, 61.0)[0] == grid(0.0, 61.0)


@pytest.mark.parametrize("far", [1e6, 1.7e9, 1e17])
def test_a_clock_that_jumps_costs_nothing(far):
    found, ticks = fired(0.0, [0.0, 0.05, far, far, far + 0.5])
    assert found[0] == 0.0
    assert all(t >= far for t in found[1:])
    assert len(found) <= 8
    assert ticks.count == len(found)


def test_the_start_counts_as_measured_and_what_is_late_fills_no_gap():
    found, _ = fired(0.0, [100.0, 100.2, 300.0, 200.0, 300.1])
    assert found == pytest.approx([0.0, 100.0, 100.1, 100.2, 300.0, 300.1])


def test_what_the_setting_may_be():
    check_tick_gap(60.0)
    for wrong in (0.0, 0.5, -1.0, float("nan"), float("inf"), 1e6):
        with pytest.raises(InputError, match="tick_gap is"):
            check_tick_gap(wrong)

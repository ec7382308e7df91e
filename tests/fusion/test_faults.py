"""Every estimator on a simulated run with what goes wrong on real ones."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from changed_logs import rows
from landmark_world import simulate, with_sightings

from factorgraph_loc.experiments.run import RunConfig, run
from factors import se2

CONFIGS = {
    "ekf": RunConfig("ekf"),
    "particle_filter": RunConfig("particle_filter", {"particles": 500}),
    "smoother": RunConfig("smoother"),
    "smoother_lag": RunConfig("smoother", {"lag": 5.0}),
    "batch": RunConfig("batch"),
}
DEAD_RECKONING = RunConfig("dead_reckoning")
EXACT = ("ekf", "smoother", "smoother_lag", "batch")  # no random numbers


@pytest.fixture(scope="module")
def log():
    return simulate(seconds=30.0)


@pytest.fixture(scope="module")
def clean(log):
    """``clean(name)``: the result on the undisturbed log, computed once."""
    return cache(lambda name: run(log, DEAD_RECKONING if name == "dead_reckoning" else CONFIGS[name]))


def distance(a, b):
    """Largest distance [m] between two trajectories or results."""
    return np.hypot(*(a.poses - b.poses)[:, :2].T).max()


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("how", ["not asked for", "no rows"])
def test_no_landmarks_is_dead_reckoning(name, how, log, clean):
    if how == "no rows":
        blind = with_sightings(log, t=np.empty(0), landmark=[], range=np.empty(0), bearing=np.empty(0))
        result = run(blind, CONFIGS[name])
    else:
        result = run(log, replace(CONFIGS[name], sensors=("odometry",)))
    expected = clean("dead_reckoning")
    n = len(result.t)
    assert n > 290
    np.testing.assert_allclose(se2.between(expected.poses[:n], result.poses), 0.0, atol=1e-6)
    np.testing.assert_allclose(se2.between(expected.final.poses[:n], result.final.poses), 0.0, atol=1e-6)


@pytest.fixture(scope="module")
def frequent():
    return simulate(rate=8.0, seconds=15.0)


@pytest.mark.parametrize("name", EXACT)
def test_too_late_rows_are_dropped(name, frequent):
    """All rows of every tenth stamp arrive 1 s late."""
    stream = frequent.streams["bearing_range"]
    stamps = np.unique(stream.t)
    chosen = stamps[:-20:10]
    slow = np.isin(stream.t, chosen)
    arrived = np.argsort(stream.t + slow, kind="stable")
    result = run(rows(frequent, "bearing_range", arrived), CONFIGS[name])
    assert result.diagnostics.late == {"bearing_range": int(slow.sum())}
    expected = run(with_sightings(frequent, ~slow), CONFIGS[name])
    assert distance(result, expected) < 1e-9
    assert distance(result.final, expected.final) < 1e-9


@pytest.mark.parametrize("name", ["ekf", "smoother"])
def test_neither_range_nor_bearing_is_ignored(name, log):
    stream = log.streams["bearing_range"]
    empty = np.arange(len(stream.t)) % 7 == 3
    holed = with_sightings(
        log, range=np.where(empty, np.nan, stream.range), bearing=np.where(empty, np.nan, stream.bearing)
    )
    result = run(holed, CONFIGS[name])
    expected = run(with_sightings(log, ~empty), CONFIGS[name])
    assert sum(result.diagnostics.ignored.values()) == empty.sum()
    assert distance(result.final, expected.final) == 0.0

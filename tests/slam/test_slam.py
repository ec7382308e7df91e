"""Landmarks that are estimated on the way, with and without a map, on a simulated run."""

from dataclasses import replace

import numpy as np
import pytest
from landmark_world import simulate
from scipy.stats import chi2

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeStream

CONFIGS = {name: RunConfig(name, {"landmarks": "unknown"}) for name in ("ekf", "smoother")}
SEEDS = range(1, 5)


@pytest.fixture(scope="module")
def logs():
    return {seed: simulate(seed=seed, seconds=30.0) for seed in SEEDS}


@pytest.fixture(scope="module")
def log(logs):
    return logs[1]


def often_seen(log):
    names, counts = np.unique(log.streams["bearing_range"].landmark, return_counts=True)
    return set(names[counts > 1].tolist())


def squared(result, truth):
    """Normalised squared errors of the landmarks."""
    errors = [(p.position - truth(name), p.covariance) for name, p in result.learnt.landmarks.items()]
    return np.array([e @ np.linalg.solve(covariance, e) for e, covariance in errors])


def with_rows(log, *rows):
    """The log with more rows (t, landmark, range, bearing), in the order of their stamps behind those that were there."""
    s = log.streams["bearing_range"]
    t, names, ranges, bearings = (list(column) for column in zip(*rows, strict=True))
    t, ranges, bearings = np.append(s.t, t), np.append(s.range, ranges), np.append(s.bearing, bearings)
    order = np.argsort(t, kind="stable")
    names = [[*s.landmark, *names][i] for i in order]
    stream = BearingRangeStream(t[order], names, ranges[order], bearings[order])
    return replace(log, streams={**log.streams, "bearing_range": stream})


def seen_from(log, t, point):
    """The exact range and bearing of a point at times ``t`` (N,)."""
    poses = log.reference.at(np.asarray(t))
    dx, dy = (point - poses[:, :2]).T
    return np.hypot(dx, dy), np.arctan2(dy, dx) - poses[:, 2]


@pytest.mark.parametrize(("name", "overconfident"), [("smoother", 1.0), ("ekf", 1.8)])
def test_errors_of_landmarks_are_as_large_as_stated(name, overconfident, logs):
    """Over four seeds, bounds of 0.1 % of false alarms on each side if all landmarks of a run are off together, as they nearly are.

    EKF-SLAM states too little, over 24 seeds 1.8 times (Julier, Uhlmann, "A counter example to the theory of simultaneous
    localization and map building", 2001).
    """
    means = [squared(run(log, CONFIGS[name]), log.world.position).mean() for log in logs.values()]
    low, high = chi2.ppf((0.001, 0.999), 2 * len(SEEDS)) / len(SEEDS)
    assert low < np.mean(means) < overconfident * high


@pytest.mark.parametrize("name", ["ekf", "smoother"])
def test_a_landmark_needs_two_sightings_that_agree(name, log):
    """One is seen once; one at first far off, then three times where it is; one each time elsewhere."""
    t, place = np.array((5.13, 6.13, 7.13)), np.array((3.0, 3.0))
    late = list(zip(t, ["late"] * 3, *seen_from(log, t, place), strict=True))
    wrong = [(t[0] + 2.0 * i, "wild", 1.0 + 1.3 * i, 2.0 * i) for i in range(3)]
    odd = with_rows(log, (4.13, "once", 2.0, 1.0), (4.13, "late", 6.0, -2.0), *late, *wrong)
    result = run(odd, CONFIGS[name])
    assert set(result.learnt.landmarks) == {*often_seen(log), "late"}
    assert np.hypot(*(result.learnt.landmarks["late"].position - place)) < 0.4


@pytest.mark.parametrize(
    ("name", "why", "located"),
    [("ekf", "unknown landmark without range and bearing", set()), ("smoother", "landmark not located yet", {"b"})],
)
def test_only_the_smoother_locates_a_landmark_by_ranges_alone(name, why, located, log):
    """Every fifth row lacks its bearing; the landmark b never had one."""
    s = log.streams["bearing_range"]
    lacks = (np.arange(len(s.t)) % 5 == 0) | (np.array(s.landmark) == "b")
    stream = replace(s, bearing=np.where(lacks, np.nan, s.bearing))
    result = run(replace(log, streams={**log.streams, "bearing_range": stream}), CONFIGS[name])
    assert result.diagnostics.ignored.keys() == {why}
    assert (result.diagnostics.ignored[why] < lacks.sum()) == (name == "smoother")
    assert set(result.learnt.landmarks) == (often_seen(log) - {"b"}) | located

"""Estimators on recorded logs: accuracy that must not get lost, and maps that are wrong."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

from factorgraph_loc import BearingRangeStream, VelocityStream, load
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import cut


@pytest.fixture(scope="module")
def plaza2():
    return load("plaza2")[0]


@pytest.fixture(scope="module")
def mrclam(data_root):
    """The first 120 s of a robot among landmarks."""
    (log,) = load("mrclam6-robot3", data_root=data_root)
    odometry, seen = log.streams["odometry"], log.streams["bearing_range"]
    moved, looked = odometry.t < 120.0, seen.t < 120.0
    names = np.array(seen.landmark)[looked].tolist()
    streams = {
        "odometry": VelocityStream(odometry.t[moved], odometry.v[moved], odometry.w[moved]),
        "bearing_range": BearingRangeStream(seen.t[looked], names, seen.range[looked], seen.bearing[looked]),
    }
    return replace(log, streams=streams)


def scores(log, estimator):
    """Of the particle filter causal ones alone: a smoothed trajectory of all its particles takes long."""
    settings = {"smooth": False} if estimator == "particle_filter" else {}
    return score(run(log, RunConfig(estimator, settings)), log)


@pytest.fixture(scope="module")
def normal(mrclam):
    """``normal(estimator)``: the scores on that part as it was recorded."""
    return cache(partial(scores, mrclam))


def test_plaza2_is_as_accurate_as_the_reference_implementation(plaza2):
    """0.333 m, 0.028 rad causal for an EKF; 0.259 m, 0.017 rad final for iSAM2; within 10 %."""
    ekf, smoother = scores(plaza2, "ekf"), scores(plaza2, "smoother")
    assert ekf["causal.position_rmse"] < 1.1 * 0.333
    assert ekf["causal.heading_rmse"] < 1.1 * 0.028
    assert smoother["final.position_rmse"] < 1.1 * 0.259
    assert smoother["final.heading_rmse"] < 1.1 * 0.017
    batch = scores(plaza2, "batch")
    assert smoother["final.position_rmse"] == pytest.approx(batch["final.position_rmse"], rel=0.02)


def test_one_place_is_claimed_though_ranges_do_not_tell_it_to_half_a_metre(plaza2):
    log = cut(plaza2, *(plaza2.streams["bearing_range"].t[0] + np.array((0.0, 30.0))))
    result = run(log, RunConfig("smoother", {"smooth": False}, prior="unknown"))
    found = next(t for t, what in result.diagnostics.events if what == "localized")
    claimed = result.t[result.status.index("localized")]
    assert found - 0.2 < claimed < found + 1.0
    assert set(result.status[result.status.index("localized") :]) == {"localized"}


def test_two_swapped_landmarks_of_the_map_do_not_double_the_error(mrclam, normal):
    landmarks = dict(mrclam.world.landmarks)
    landmarks["6"], landmarks["15"] = landmarks["15"], landmarks["6"]
    wrong = replace(mrclam, world=mrclam.world.model_copy(update={"landmarks": landmarks}))
    seen = set(mrclam.streams["bearing_range"].landmark)
    assert {"6", "15"} <= seen
    assert scores(wrong, "smoother")["final.position_rmse"] < 2.0 * normal("smoother")["final.position_rmse"]


@pytest.mark.parametrize(("estimator", "kind"), [("ekf", "causal"), ("smoother", "final")])
def test_a_tenth_of_gross_outliers_does_not_double_the_error(mrclam, normal, estimator, kind):
    rng = np.random.default_rng(2)
    seen = mrclam.streams["bearing_range"]
    bad = rng.random(len(seen.t)) < 0.1
    ranges = np.where(bad, rng.uniform(0.3, 10.0, len(seen.t)), seen.range)
    bearings = np.where(bad, rng.uniform(-np.pi, np.pi, len(seen.t)), seen.bearing)
    dirty = replace(
        mrclam, streams={**mrclam.streams, "bearing_range": BearingRangeStream(seen.t, seen.landmark, ranges, bearings)}
    )
    assert scores(dirty, estimator)[f"{kind}.position_rmse"] < 2.0 * normal(estimator)[f"{kind}.position_rmse"]

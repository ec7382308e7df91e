"""What a sensor, a map or a rig may say within their bounds, however absurd: no graph ends in an error, or in what is no number."""

from dataclasses import replace

import numpy as np
import pytest
from landmark_world import simulate

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.incremental import Incremental
from factorgraph_loc.model.log import StartPose
from factorgraph_loc.sensors.odometry.measurement import IncrementStream
from factorgraph_loc.sensors.odometry.settings import GrowthSettings, OdometryNoise

CONFIGS = {
    "smoother": RunConfig("smoother"),
    "window": RunConfig("smoother", {"lag": 3.0}),
    "batch": RunConfig("batch"),
    "mapping": RunConfig("smoother", {"landmarks": "unknown"}),
    "mapping_window": RunConfig("smoother", {"landmarks": "unknown", "lag": 3.0}),
}
EVERY = pytest.mark.parametrize("config", CONFIGS.values(), ids=list(CONFIGS))


@pytest.fixture(scope="module")
def log():
    return simulate(seconds=6.0, rate=3.0)


def with_stream(log, name, **columns):
    return replace(log, streams={**log.streams, name: replace(log.streams[name], **columns)})


def with_landmarks(log, place):
    """With landmarks that ``place`` (2,) puts elsewhere."""
    moved = {
        n: m.model_copy(update=dict(zip("xy", place(m.x, m.y), strict=True))) for n, m in log.world.landmarks.items()
    }
    return replace(log, world=log.world.model_copy(update={"landmarks": moved}))


def glitches(log):
    rng, odometry = np.random.default_rng(3), log.streams["odometry"]
    moves = np.zeros((3, len(odometry.t)))
    moves[:, rng.integers(len(odometry.t), size=6)] = rng.choice((-1000.0, 1000.0), (3, 6))
    stream = IncrementStream(odometry.t, moves[0], moves[1], moves[2] / 10.0)
    return replace(log, streams={**log.streams, "odometry": stream})


def one_row_each(log):
    odometry, seen = log.streams["odometry"], log.streams["bearing_range"]
    first = with_stream(log, "odometry", t=odometry.t[:1], v=odometry.v[:1], w=odometry.w[:1])
    row = {"t": seen.t[:1], "landmark": seen.landmark[:1], "range": seen.range[:1], "bearing": seen.bearing[:1]}
    return with_stream(first, "bearing_range", **row)


def extremes_of_noise(log):
    growth = GrowthSettings(per_distance=1e-9), GrowthSettings(per_distance=5.0, per_rotation=5.0, per_time=5.0)
    odometry = log.rig.odometry.model_copy(
        update={"noise": OdometryNoise(along=growth[0], lateral=growth[0], heading=growth[1])}
    )
    sensor = log.rig.bearing_range.model_copy(update={"range_sigma": 1e-6, "bearing_sigma": 1e-6})
    return replace(log, rig=log.rig.model_copy(update={"odometry": odometry, "bearing_range": sensor}))


FAULTS = {
    "increments of a kilometre": glitches,
    "ranges of a millimetre": lambda log: with_stream(
        log, "bearing_range", range=0.0 * log.streams["bearing_range"].range + 1e-3
    ),
    "ranges of a hundred kilometres": lambda log: with_stream(
        log, "bearing_range", range=0.0 * log.streams["bearing_range"].range + 1e5
    ),
    "one stamp": lambda log: with_stream(log, "bearing_range", t=0.0 * log.streams["bearing_range"].t + 1.0),
    "one row each": one_row_each,
    "landmarks in one place": lambda log: with_landmarks(log, lambda *_: (1.0, 1.0)),
    "landmarks where the robot begins": lambda log: with_landmarks(log, lambda *_: (0.0, 0.0)),
    "a map that is far away": lambda log: with_landmarks(log, lambda x, y: (x + 1e7, -y)),
    "a start that is far away": lambda log: replace(
        log, start=StartPose(0.0, np.array((-3e5, 2e6, 1.0)), np.array((1e-7, 1e-7, 5e-8)))
    ),
    "noise at its bounds": extremes_of_noise,
}


@EVERY
@pytest.mark.parametrize("fault", FAULTS.values(), ids=list(FAULTS))
def test_whatever_is_told_a_graph_has_an_estimate(fault, config, log):
    result = run(fault(log), config)
    said = np.array([status != "unlocalized" for status in result.status])
    for poses, covariances in (
        (result.poses[said], result.covariances[said]),
        (result.final.poses, result.final.covariances),
    ):
        assert np.all(np.isfinite(poses))
        assert np.all(np.isfinite(covariances))
        assert np.all(np.diagonal(covariances, axis1=1, axis2=2) > 0.0)


@pytest.mark.parametrize("lag", [None, 2.0])
def test_a_graph_that_cannot_be_solved_for_a_while_goes_on_as_a_filter(lag, log, monkeypatch):
    config = RunConfig("smoother", {} if lag is None else {"lag": lag})
    expected, marginal = run(log, config), Incremental._marginal

    def failing(self, key, *known, **where):
        if 2.0 < self._graph.t < 3.5:
            raise RuntimeError("\n")
        return marginal(self, key, *known, **where)

    monkeypatch.setattr(Incremental, "_marginal", failing)
    result = run(log, config)
    assert [what for _, what in result.diagnostics.events if what.startswith("goes on without a solver until")]
    assert set(result.status) == {"localized"}
    assert np.abs(result.poses - expected.poses)[:, :2].max() < 0.2
    assert np.abs(result.poses[-1] - expected.poses[-1])[:2].max() < 0.05
    assert np.abs(result.final.poses - expected.final.poses)[:, :2].max() < 0.2

"""What a run keeps grows with the length of its log, and by how much is stated in the docs: so that of hours fits a computer."""

import tracemalloc

import numpy as np
import pytest

from factorgraph_loc import BearingRangeStream, Landmark, Log, Rig, Trajectory, VelocityStream, World
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings
from factors import se2
from factors.landmarks import model as bearing_range

PLACES = {"a": (0.0, 0.0), "b": (10.0, 0.0), "c": (10.0, 8.0), "d": (0.0, 8.0)}
SETTINGS = BearingRangeSettings(range_sigma=0.1, bearing_sigma=0.03)


def circling(seconds):
    """Wheels at 20 Hz, and four landmarks twice a second."""
    t = np.arange(0.0, seconds, 0.05)
    heading = t / 8.0
    poses = np.stack((5.0 + 3.0 * np.sin(heading), 4.0 - 3.0 * np.cos(heading), se2.wrap(heading)), axis=-1)
    seen = np.repeat(np.arange(0, len(t), 10), len(PLACES))
    marks = np.tile(list(PLACES.values()), (len(seen) // len(PLACES), 1))
    streams = {
        "odometry": VelocityStream(t, np.full(len(t), 0.375), np.full(len(t), 0.125)),
        "bearing_range": BearingRangeStream(
            t[seen],
            list(PLACES) * (len(seen) // len(PLACES)),
            *bearing_range.predict(SETTINGS.model(), poses[seen], marks),
        ),
    }
    world = World(landmarks={name: Landmark(x=x, y=y) for name, (x, y) in PLACES.items()})
    return Log("circle", Rig(bearing_range=SETTINGS), world, streams, Trajectory(t, poses))


def peak(log, config):
    tracemalloc.start()
    run(log, config)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return most


@pytest.mark.parametrize(
    ("config", "most"),
    [(RunConfig("dead_reckoning"), 100e6), (RunConfig("ekf"), 200e6), (RunConfig("smoother", {"lag": 5.0}), 250e6)],
    ids=["dead_reckoning", "ekf", "smoother in a window"],
)
def test_an_hour_of_log_takes_no_more_than_is_stated(config, most):
    short, long = circling(20.0), circling(60.0)
    run(short, config)  # what is compiled, imported and cached once
    grown = peak(long, config) - peak(short, config)
    assert 0 < grown / 40.0 * 3600.0 < most

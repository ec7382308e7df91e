"""What an estimator says at a time is the same whether the log goes on or not: every estimator on every sensor."""

from dataclasses import replace

import numpy as np
import pytest
from picture import SMALL, moved_over
from short_logs import frames, late, office, plaza, room, with_gyro

from factorgraph_loc import ImageStream, InputError, PointMap, World
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.registry import ESTIMATORS
from factorgraph_loc.model.log import cut
from factorgraph_loc.model.measurement import selected
from factorgraph_loc.vision.settings import FrontendSettings

READS = ("odometry", "rfid")
FEW = {"particles": 150, "min_particles": 100, "smooth": False}
SETTINGS = {
    "ekf": {"smooth": False},
    "particle_filter": FEW,
    "switching": {"particles": FEW["particles"], "smooth": False},
    "smoother": {"smooth": False},
    "monoslam": {"smooth": False},
}


def prefix(log, end):
    """What arrived by the time ``end`` [s]: a late row arrives with the latest one before it."""

    def until(name, stream):
        keep = np.maximum.accumulate(stream.t + log.rig.time_offset(name)) <= end
        return selected(stream, keep)

    return replace(log, streams={name: until(name, stream) for name, stream in log.streams.items()})


LOGS = {
    "ranges": (plaza, {}),
    "landmarks": (office, {"sensors": ("odometry", "bearing_range")}),
    "late landmarks": (lambda: late(office(), "bearing_range"), {"sensors": ("odometry", "bearing_range")}),
    "rfid": (office, {"sensors": READS}),
    "rssi": (office, {"sensors": (*READS, "rssi")}),
    "phase": (office, {"sensors": (*READS, "phase")}),
    "gyro": (lambda: with_gyro(office()), {"sensors": ("odometry", "imu", "bearing_range")}),
    "sightings": (room, {}),
    "camera": (frames, {}),
    "unknown start by landmarks": (office, {"sensors": ("odometry", "bearing_range"), "prior": "unknown"}),
    "unknown start by tags": (office, {"sensors": READS, "prior": "unknown"}),
    "unknown start by features": (frames, {"prior": "unknown"}),
}


def attempt(log, config):
    """What a run gives, or why it is refused."""
    try:
        return run(log, config)
    except InputError as error:
        return str(error)


def check(log, config, middle):
    """The estimates until ``middle`` are those of a log that ends there, to the bit; or both are refused for the same reason."""
    short = prefix(log, middle)
    whole, part = attempt(log, config), attempt(short, config)
    if isinstance(whole, str):
        assert part == whole
        assert "cannot start from an unknown pose" in whole
        return
    n = len(part.t)
    assert whole.t[n - 1] > middle - 0.4
    assert len(whole.t) > n
    np.testing.assert_array_equal(part.t, whole.t[:n])
    assert part.status == whole.status[:n]
    np.testing.assert_array_equal(part.poses, whole.poses[:n])
    np.testing.assert_array_equal(part.covariances, whole.covariances[:n])


@pytest.mark.parametrize("kind", LOGS)
@pytest.mark.parametrize("name", ESTIMATORS)
def test_causal_estimates_do_not_know_what_comes(name, kind):
    make, more = LOGS[kind]
    log = make()
    first, last = log.span()
    check(log, RunConfig(name, SETTINGS.get(name, {}), **more), (first + last) / 2.0)


@pytest.mark.parametrize(
    ("name", "kind", "settings"),
    [
        ("ekf", "landmarks", {"landmarks": "unknown"}),
        ("smoother", "landmarks", {"landmarks": "unknown"}),
        ("smoother", "sightings", {"landmarks": "unknown"}),
        ("smoother", "camera", {"landmarks": "unknown"}),
        ("monoslam", "camera", {"landmarks": "unknown"}),
        ("smoother", "landmarks", {"lag": 3.0}),
        ("smoother", "rfid", {"lag": 3.0}),
        ("smoother", "landmarks", {"self_calibration": False}),
    ],
)
def test_nor_with_other_settings(name, kind, settings):
    make, more = LOGS[kind]
    log = make()
    first, last = log.span()
    if kind == "camera":  # of which each second takes long
        log = cut(log, first, last := first + 4.0)
    check(log, RunConfig(name, SETTINGS[name] | settings, **more), (first + last) / 2.0)


@pytest.mark.parametrize("name", ["smoother", "monoslam"])
def test_nor_do_features_that_are_found_in_images(name, tmp_path):
    settings = SMALL.model_copy(update={"frontend": FrontendSettings(feature="orb", count=60)})
    log = room()
    rig = log.rig.model_copy(update={"camera": settings, "sensors": ("odometry", "camera")})
    streams = {
        "odometry": cut(log, 0.0, 2.6).streams["odometry"],
        "camera": ImageStream(0.13 + 0.2 * np.arange(12), moved_over(tmp_path, 12)),
    }
    log = replace(log, rig=rig, streams=streams, world=World(points=PointMap.of((), np.empty((0, 3)))))
    config = RunConfig(name, SETTINGS[name] | {"landmarks": "unknown"}, prior="0,0,0")
    check(log, config, 1.3)

"""What an estimate depends on: not on what comes later, on what was forgotten, or on whether causal estimates are made."""

from dataclasses import replace
from functools import cache

import landmark_world
import numpy as np
import pytest
from by_hand import made
from picture import SMALL, moved_over
from short_logs import frames, late, office, plaza, room, with_gyro

from factorgraph_loc import ImageStream, InputError, PointMap, World
from factorgraph_loc.experiments.preparation import resolve_prior
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.graph.isam import Incremental
from factorgraph_loc.fusion.registry import ESTIMATORS, settings_of
from factorgraph_loc.model.log import cut
from factorgraph_loc.model.measurement import Tick, selected
from factorgraph_loc.sensors.camera.settings import FrontendSettings
from factorgraph_loc.simulation import named_settings, simulate

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


CASES = [
    ("dead_reckoning", ("odometry",), {}),
    ("ekf", ("odometry", "bearing_range"), {}),
    ("particle_filter", ("odometry", "bearing_range"), {"particles": 300, "smooth": False}),
    ("switching", ("odometry", "rfid", "bearing_range"), {"particles": 300}),
    ("smoother", ("odometry", "bearing_range"), {"lag": 3.0}),
    ("smoother", ("odometry", "bearing_range"), {"lag": 3.0, "landmarks": "unknown"}),
    ("smoother", ("odometry", "rfid"), {"lag": 3.0, "smooth": False}),
    ("smoother", ("odometry", "sightings"), {"lag": 3.0, "landmarks": "unknown"}),
]


@pytest.fixture(scope="module")
def log():
    changes = {"drive": {"duration": 60.0}, "world": {"tags": 12, "landmarks": 12, "points": 200}}
    return simulate(named_settings("office", changes), 4)


@pytest.fixture(scope="module")
def driven(log):
    """``driven(name, sensors, settings, forget)``: what :func:`drive` gives, computed once."""
    once = cache(lambda name, sensors, settings, forget: drive(log, name, sensors, dict(settings), forget))
    return lambda name, sensors, settings, forget: once(name, sensors, tuple(settings.items()), forget)


def drive(log, name, sensors, settings, forget):
    """An estimator after a log with late measurements, which forgets what is older than ``forget`` seconds."""
    estimator = made(name, log.rig, log.world, sensors, 1, **settings)
    prior, _ = resolve_prior(log, None)
    estimator.initialize(prior)
    held, causal = None, []
    for i, m in enumerate(m for m in log.measurements(sensors) if m.t > prior.t):
        estimator.process(m)
        if held is not None and m.t > held.t + 0.3:
            estimator.process(held)
            held = None
        elif held is None and i % 7 == 0 and not m.is_motion:
            held = m
        if i % 5 == 0:
            estimator.process(Tick(m.t))
            causal.append(estimator.estimate().pose)
            if forget is not None:
                estimator.forget(m.t - forget)
    return estimator, np.array(causal)


@pytest.mark.parametrize(("name", "sensors", "settings"), CASES)
def test_what_is_left_is_the_same(driven, name, sensors, settings):
    whole, estimates = driven(name, sensors, settings, None)
    short, same = driven(name, sensors, settings, 0.0)
    assert np.array_equal(same, estimates)
    expected, left = whole.trajectory(), short.trajectory()
    assert 0 < len(left) < len(expected)
    assert left.t == pytest.approx(expected.t[-len(left) :], abs=0.0)
    assert left.poses == pytest.approx(expected.poses[-len(left) :], abs=1e-9)
    assert left.covariances == pytest.approx(expected.covariances[-len(left) :], abs=1e-9)


def test_clouds_are_kept_as_far_as_smoothing_needs_them(log, driven):
    settings = {"particles": 300, "smoothing_interval": 5.0}
    estimator, _ = driven("particle_filter", ("odometry", "bearing_range"), settings, 2.0)
    left = estimator.trajectory()
    end = log.span()[1]
    assert end - 13.0 < left.t[0] < end - 2.0
    assert np.all(np.isfinite(left.poses))


def test_a_full_history_forgets_nothing(driven):
    whole, _ = driven("smoother", ("odometry", "bearing_range"), {}, None)
    short, _ = driven("smoother", ("odometry", "bearing_range"), {}, 1.0)
    assert len(short.trajectory()) == len(whole.trajectory())


@pytest.fixture(scope="module")
def brief():
    return landmark_world.simulate(seconds=15.0)


def test_the_final_trajectory_is_that_of_a_run_with_causal_estimates(brief, monkeypatch):
    whole = run(brief, RunConfig("smoother"))
    monkeypatch.setattr(Incremental, "__init__", None)  # nothing is solved on the way
    found = run(brief, RunConfig("smoother", {"final_only": True}))
    np.testing.assert_allclose(found.final.poses, whole.final.poses, atol=1e-3)
    np.testing.assert_allclose(found.final.covariances, whole.final.covariances, rtol=0.05, atol=1e-6)
    assert whole.causal() is not None
    assert found.causal() is None
    assert found.learnt.values.keys() == whole.learnt.values.keys()


@pytest.mark.parametrize("other", [{"lag": 10.0}, {"smooth": False}])
def test_a_final_trajectory_that_needs_causal_estimates_is_refused(other):
    with pytest.raises(InputError, match=r"final_only is true, but (lag is 10|smooth is false)"):
        settings_of("smoother", {"final_only": True} | other)
    assert settings_of("smoother", {"final_only": True, "lag": "all"})

"""Estimators that forget their past: what is left is what it would be with all of it."""

from functools import cache

import numpy as np
import pytest
from by_hand import made

from factorgraph_loc.experiments.preparation import resolve_prior
from factorgraph_loc.model.measurement import Tick
from factorgraph_loc.simulation import named_settings, simulate

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

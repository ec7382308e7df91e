"""Offsets of a camera's clock are told, and the noise of the odometry is not taken for one."""

import numpy as np
import pytest

from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.camera.clock_check import ClockCheck
from factorgraph_loc.sensors.odometry.measurement import IncrementOdometry
from factorgraph_loc.sensors.odometry.motion import OdometryMotion
from factorgraph_loc.sensors.odometry.settings import GrowthSettings, OdometryNoise, OdometrySettings

STEP, EVERY = 0.1, 2  # s between rows of the odometry, rows between images
NOISE = 0.1  # rad per sqrt(s)
SEEN = 0.002  # rad: noise of what an image tells of the heading


def told(seed, offset, noise=NOISE):
    """The events of a run of 200 s in which images are taken ``offset`` later than they are stamped."""
    rng = np.random.default_rng(seed)
    heading = OdometryNoise(heading=GrowthSettings(per_time=noise))
    diagnostics = Diagnostics()
    motion = OdometryMotion(Rig(odometry=OdometrySettings(noise=heading)), ("odometry",), diagnostics)
    check = ClockCheck(motion, diagnostics)
    t = np.arange(2000) * STEP
    true = lambda t: 0.8 * np.sin(0.7 * t) + 0.3 * np.sin(1.9 * t)  # noqa: E731
    errors = noise * np.sqrt(STEP) * rng.standard_normal(len(t))
    turns = np.diff(true(t), prepend=true(0.0)) - errors
    before = 0.0
    for i, now in enumerate(t.tolist()):
        motion.add(IncrementOdometry(now, 0.0, 0.0, float(turns[i])))
        if i and i % EVERY == 0:
            seen = true(now + offset) + SEEN * rng.standard_normal()
            predicted = before + turns[i - EVERY + 1 : i + 1].sum()
            check.add(now, float(seen - predicted))
            before = seen
    return [what for _, what in diagnostics.events]


@pytest.mark.parametrize("noise", [1e-4, 0.03, NOISE])
def test_a_right_clock_is_not_doubted(noise):
    """20 runs; five standard deviations leave a false alarm in less than one of 10,000 tests of some hundred images."""
    assert [told(seed, 0.0, noise) for seed in range(20)] == [[]] * 20


@pytest.mark.parametrize("offset", [0.1, -0.1])
def test_an_offset_is_told_once(offset):
    for seed in range(5):
        (event,) = told(seed, offset, 0.03)
        assert f"s {'later' if offset > 0.0 else 'earlier'} than they are stamped" in event
        assert float(event.split("taken ")[1].split(" s ")[0]) == pytest.approx(0.1, abs=0.04)


def test_where_the_turns_are_all_noise_nothing_is_told():
    assert told(0, 0.1, 1.0) == []

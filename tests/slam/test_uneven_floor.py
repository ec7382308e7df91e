"""How level a floor is is learnt from changes of the tilt, whatever the points lean by."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.slam.monoslam_motion import ROBOT, UNEVEN, RobotState, exp, on_the_floor, standstill, tilt_of
from factorgraph_loc.slam.monoslam_state import SlamState, with_floor
from factors.camera.model import TiltScale
from factors.motion import ChainState

RATE, TOLD = 0.2, 0.001  # s from image to image; rad, how well each tells the tilt
LEAN = np.array((0.02, -0.01))  # rad, of all points


def learnt(sigma, seed, lean, count=200):
    """What is believed of a floor that is level to ``sigma`` [rad] after ``count`` images of points that ``lean`` (2,)."""
    rng = np.random.default_rng(seed)
    keep = np.exp(-RATE / UNEVEN)
    tilt = sigma * rng.standard_normal(2)
    robot = RobotState(np.zeros(3), exp(np.array((*lean, 0.0))), np.zeros(3), np.zeros(3))
    state = SlamState(robot, np.zeros(0), 1e-9 * np.eye(ROBOT), floor=TiltScale.guessed(0.005))
    for k in range(count):
        tilt = keep * tilt + np.sqrt(1.0 - keep**2) * sigma * rng.standard_normal(2)
        before = state.moved(on_the_floor(standstill(state.robot), RATE, 0.005, state.floor.sigma, UNEVEN))
        gain = before.covariance[:, :2] @ np.linalg.inv(before.covariance[:2, :2] + TOLD**2 * np.eye(2))
        off = tilt + lean + TOLD * rng.standard_normal(2) - tilt_of(before.robot)
        after = before.plus(gain @ off, before.covariance - gain @ before.covariance[:2])
        after = with_floor(before, after, k * RATE)
        state = replace(after, image_odometry=ChainState(k * RATE, *np.zeros(7)))
    return state.floor.sigma


@pytest.mark.parametrize(("sigma", "lean"), [(0.001, 0.0 * LEAN), (0.005, LEAN), (0.015, LEAN)])
def test_the_scale_of_the_tilt_is_found(sigma, lean):
    found = [learnt(sigma, seed, lean) for seed in range(8)]
    assert np.exp(np.mean(np.log(found))) == pytest.approx(sigma, rel=0.3)

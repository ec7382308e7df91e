"""Where the robot is when the image of a keyframe is taken, with an estimated time offset of the camera."""

from types import SimpleNamespace

import numpy as np
import pytest

from factorgraph_loc.fusion.graph.graph import Keyframe
from factorgraph_loc.model.settings import Estimated
from factorgraph_loc.slam.keyframe_cameras import KeyframeCameras
from factors import se2
from factors.camera.model import PARAMETERS, CameraModel
from factors.motion import ChainState

MODEL = CameraModel(370.0, 370.0, 240.0, 180.0, width=480, height=360)
OFFSET, SIGMA, TWIST = 0.4, 0.05, np.array((0.8, -0.1, 0.9))
POSE = np.array((2.0, -1.0, 0.7))
ROOT = np.array(((0.1, 0.0, 0.0), (0.02, 0.2, 0.0), (0.0, -0.03, 0.06)))
STEP = 1e-6
GRAPH = SimpleNamespace(
    mapped_constants=7,
    values={7: np.array((0.02, OFFSET))},
    covariances={7: np.diag((0.01, SIGMA)) ** 2},
    motion=SimpleNamespace(twist=lambda _: TWIST),
)


@pytest.fixture
def cameras():
    sigmas = np.array([{"focal": 0.01, "time_offset": SIGMA}.get(name, 0.0) for name in PARAMETERS])
    found = KeyframeCameras(MODEL, Estimated.among(PARAMETERS, sigmas))
    found.add(Keyframe(3, 1.5, ChainState(1.5, *np.zeros(7)), None), GRAPH)
    return found


def at_image(xi, offset):
    """The pose at the time of the image, of a robot that is at POSE moved by ``xi`` (3,) at the stamp."""
    return se2.compose(se2.compose(POSE, se2.exp(xi)), se2.exp(offset * TWIST))


def test_the_covariance_at_the_image_is_that_of_the_motion_to_it(cameras):
    pose, covariance = cameras.at_image(3, (POSE, ROOT @ ROOT.T), GRAPH)
    expected = at_image(np.zeros(3), OFFSET)
    assert pose == pytest.approx(expected)
    moved = [at_image(STEP * axis, OFFSET) for axis in np.eye(3)] + [at_image(np.zeros(3), OFFSET + STEP)]
    jacobian = np.column_stack([se2.log(se2.between(expected, there)) / STEP for there in moved])
    before = np.zeros((4, 4))
    before[:3, :3], before[3, 3] = ROOT @ ROOT.T, SIGMA**2
    assert covariance == pytest.approx(jacobian @ before @ jacobian.T, rel=1e-4, abs=1e-8)


def test_the_pose_at_the_stamp_is_that_before_the_motion_to_the_image(cameras):
    guess = POSE, ROOT @ ROOT.T
    pose, covariance = cameras.at_stamp(3, cameras.at_image(3, guess, GRAPH), GRAPH)
    assert pose == pytest.approx(guess[0])
    assert covariance == pytest.approx(guess[1])


def test_keyframes_that_are_forgotten_leave_nothing(cameras):
    cameras.anchor(Keyframe(3, 1.5, ChainState(1.5, *np.zeros(7)), None), 9)
    cameras.forget(3)
    assert cameras.twists.keys() == cameras.anchored.keys() == {3}
    cameras.forget(4)
    assert not cameras.twists
    assert not cameras.anchored

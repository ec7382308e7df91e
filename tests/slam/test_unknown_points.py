"""Where points of the graph place the robot."""

from types import SimpleNamespace

import numpy as np
import pytest

from factorgraph_loc.fusion.graph.graph import Keyframe
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.slam.unknown_points import UnknownPoints, _Point
from factors import se2
from factors.camera.model import CameraModel, predict
from factors.motion import ChainState, Increment

MODEL = CameraModel(370.0, 370.0, 240.0, 180.0, width=480, height=360, position=np.array((0.1, 0.0, 0.6)))
GUESS = np.zeros(3), np.diag((0.2, 0.2, 0.05)) ** 2
STEP, SLIPPED = np.diag((0.05, 0.05, 0.02)) ** 2, np.diag((0.3, 0.3, 0.15)) ** 2
FEW = np.array(((3.0, -0.5, 0.4), (4.0, 0.6, 1.0), (5.0, -0.2, 1.4), (2.5, 0.3, 0.7)))


def placed(moved, last, step=STEP):
    """The pose (3,) from four points that were seen at ``last`` [s], by a robot that ``moved`` (3,) from its guess after a ``step``
    of this covariance (3, 3); and how many of them count."""
    points = UnknownPoints(MODEL, Diagnostics())
    known = [_Point(i, last, 1e4 * np.eye(3)) for i in range(len(FEW))]
    keyframes = [
        Keyframe(i, t, ChainState(t, *np.zeros(7)), Increment(np.zeros(3), step, t - 4.0))
        for i, t in ((0, 4.0), (1, 10.0))
    ]
    motion = SimpleNamespace(slip=lambda _: (np.zeros((3, 3)), np.inf))
    graph = SimpleNamespace(current=FEW.__getitem__, keyframes=keyframes, motion=motion)
    pixels, _ = predict(MODEL, se2.exp(np.asarray(moved)), FEW)
    none = np.zeros(len(FEW), dtype=bool)
    named = SimpleNamespace(names=tuple("abcd"))
    image = SimpleNamespace(m=named, keyframe=keyframes[1], graph=graph, model=MODEL)
    (pose, _), _, _, right = points._placed(image, known, pixels, GUESS, none)
    return pose, np.count_nonzero(right)


@pytest.mark.parametrize("last", [9.5, 1.0])
def test_points_place_a_robot_near_its_guess(last):
    moved = (0.1, -0.1, 0.04)
    pose, count = placed(moved, last)
    assert count == len(FEW)
    assert np.allclose(pose, se2.exp(np.array(moved)), atol=0.02)


@pytest.mark.parametrize("moved", [(0.1, -0.2, 0.4), (0.5, 0.0, 0.0)], ids=["from its guess", "since they were seen"])
def test_a_few_points_seen_lately_do_not_place_it_where_it_cannot_be(moved):
    """They agree, which wrong matches do, too; seen long ago, they may close a loop."""
    pose, count = placed(moved, 9.5)
    assert count == 0
    assert np.array_equal(pose, GUESS[0])
    pose, count = placed(moved, 1.0)
    assert count == len(FEW)
    assert np.allclose(pose, se2.exp(np.array(moved)), atol=0.08)


def test_wheels_that_slipped_may_have_taken_it_far():
    moved = (0.5, 0.0, 0.0)
    pose, count = placed(moved, 9.5, SLIPPED)
    assert count == len(FEW)
    assert np.allclose(pose, se2.exp(np.array(moved)), atol=0.08)

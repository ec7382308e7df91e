"""When an image becomes a keyframe for points that are estimated."""

from dataclasses import replace

import camera_world
import numpy as np

from factorgraph_loc import CameraFrame, Rig, VelocityOdometry, World
from factorgraph_loc.fusion.graph.estimator import Smoother, SmootherSettings
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.odometry.settings import OdometrySettings


def keyframe_times(common):
    """The times of keyframes of images at 0.0, 0.2 and 0.4 s, each with the share ``common`` of its 50 features from the first."""
    rig = Rig(name="r", sensors=("odometry", "camera"), odometry=OdometrySettings(), camera=camera_world.CAMERA)
    smoother = Smoother(
        Setup(rig, World(name="w"), ("odometry", "camera"), np.random.default_rng(0)),
        SmootherSettings(landmarks="unknown"),
    )
    smoother.initialize(PosePrior(0.0, np.zeros(3), 0.01 * np.eye(3)))
    smoother.process(VelocityOdometry(0.0, 0.0, 0.0))
    rng = np.random.default_rng(0)
    look = CameraFrame(
        *(0.0, "orb", rng.uniform(50.0, 400.0, (50, 2)), np.full(50, 31.0), np.zeros((50, 32), dtype=np.uint8)),
        np.arange(50),
    )
    for i in range(3):
        tracks = np.where(np.arange(50) < round(50 * common), look.tracks, look.tracks + 100 * i)
        smoother.process(replace(look, t=0.1 + 0.2 * i, tracks=tracks))
    return [round(k.t, 3) for k in smoother._graph.keyframes.values()]


def test_an_image_with_little_in_common_with_the_last_keyframe_becomes_one():
    assert keyframe_times(0.5) == [0.0, 0.1]
    assert keyframe_times(0.1) == [0.0, 0.1, 0.3, 0.5]

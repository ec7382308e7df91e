"""A map learnt from images of known points, and where the images of a log were taken."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from factorgraph_loc import FeatureStream, Log, Rig, RunFailedError, Trajectory, World
from factorgraph_loc.mapping.bundle import pose3
from factorgraph_loc.mapping.point_mapping import PointSettings, PosedFrames, map_points, posed_frames
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factors.camera.model import camera_pose

ALL = PointSettings(distance=0.0, angle=0.0)


def posed(sight, cameras=None, turn=0.002, shift=0.004):
    count = len(sight.frames)
    spread = np.repeat(np.diag(np.repeat(np.square((turn, shift)), 3))[None], count, axis=0)
    return PosedFrames(sight.frames, sight.cameras if cameras is None else cameras, spread)


def nearest(sight, made):
    """Which true point each of the map is."""
    return np.linalg.norm(made.points.positions[:, None] - sight.points, axis=2).argmin(axis=1)


def test_points_are_where_they_are_and_known_so_well(look):
    """Squared errors in units of their covariances; the poses' errors are common to the points, so that the bounds are for the
    number of scenes: 1 false alarm in 1000."""
    scaled = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        sight = look(rng, noise=0.8, points=120)
        made = map_points(sight.model, posed(sight, sight.moved(rng, 0.005, 0.01), 0.005, 0.01), ALL)
        assert len(made.points) > 100
        truth = sight.points[nearest(sight, made)]
        error = made.points.positions - truth
        assert np.linalg.norm(error, axis=1).max() < 0.15
        scaled.append(np.mean(np.einsum("pi,pij,pj->p", error, np.linalg.inv(made.points.covariances), error)))
    low, high = chi2.ppf((0.0005, 0.9995), 3 * len(scaled)) / len(scaled)
    assert low < np.mean(scaled) < high


def test_the_report_tells_what_was_done(look):
    rng = np.random.default_rng(1)
    sight = look(rng, noise=0.6)
    made = map_points(sight.model, posed(sight, sight.moved(rng, 0.01, 0.02), 0.01, 0.02), ALL)
    report = made.report
    assert report.points == len(made.points)
    assert report.keyframes == 12
    assert report.rms == pytest.approx(0.6, rel=0.15)
    assert report.mad == pytest.approx(0.6745 * 0.6, rel=0.15)
    assert 0.005 < report.shifted < 0.05
    assert report.focal == 525.0


def test_views_differ_and_are_few(look):
    sight = look(np.random.default_rng(2))
    points = map_points(sight.model, posed(sight), ALL.model_copy(update={"views": 3})).points
    counts = np.bincount(points.owners, minlength=len(points))
    assert (counts.min(), counts.max()) == (3, 3)
    assert points.descriptors.shape == (len(points.owners), 16)
    of_first = points.seen_from[points.owners == 0]
    assert np.linalg.norm(of_first[0] - of_first, axis=1)[1:].min() > 0.3  # of an arc of 3.4 m


def test_points_seen_too_seldom_or_known_too_badly_are_dropped(look):
    sight = look(np.random.default_rng(3))
    with pytest.raises(RunFailedError, match="seen in 13 keyframes"):
        map_points(sight.model, posed(sight), ALL.model_copy(update={"observations": 13}))
    with pytest.raises(RunFailedError, match="known to 1e-06 m"):
        map_points(sight.model, posed(sight), ALL.model_copy(update={"sigma": 1e-6}))


def camera_log(sight, **changes):
    t = np.array([frame.t for frame in sight.frames])
    rig = Rig(camera=CameraSettings(fx=525, fy=520, cx=320, cy=240, x=0.1, z=1.0, pitch=-0.2))
    return replace(Log("walk", rig, World(), {"camera": FeatureStream(t, sight.frames)}), **changes)


def test_poses_of_a_robot_on_the_floor(look):
    log = camera_log(look(np.random.default_rng(5)))
    t = np.linspace(0.0, 1.1, 12)
    poses = np.column_stack((0.3 * t, 0.1 * t, 0.2 * t))
    spread = np.diag((0.01, 0.02, 0.03)) ** 2
    reference = Trajectory(t, poses, np.repeat(spread[None], 12, axis=0))
    found = posed_frames(replace(log, reference=reference), 0.01, 0.02)
    model = log.rig.camera.model()
    position, rotation = camera_pose(model, poses[4])
    np.testing.assert_allclose(found.cameras.positions[4], position)
    np.testing.assert_allclose(found.cameras.rotations[4], rotation)
    # the covariance as that of many poses
    drawn = poses[4] + np.random.default_rng(0).multivariate_normal(np.zeros(3), spread, 4000)
    errors = [gtsam.Pose3.Logmap(pose3(position, rotation).between(pose3(*camera_pose(model, p)))) for p in drawn]
    np.testing.assert_allclose(found.covariances[4], np.cov(np.array(errors).T), atol=0.08 * found.covariances[4].max())
    plain = posed_frames(replace(log, reference=Trajectory(t, poses)), 0.01, 0.02)
    np.testing.assert_allclose(np.diag(plain.covariances[0]), np.square([0.01] * 3 + [0.02] * 3))

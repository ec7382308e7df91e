"""A map learnt from images of known points, and where the images of a log were taken."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from scipy.stats import chi2

from factorgraph_loc import FeatureStream, Log, Rig, RunFailedError, Trajectory, World
from factorgraph_loc.mapping.bundle import adjust, marginals, pose3
from factorgraph_loc.mapping.point_mapping import PointSettings, PosedFrames, map_points, posed_frames
from factorgraph_loc.mapping.triangulation import Cameras, Tracks, parallax, triangulate
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factors.camera.model import camera_pose, project, recalibrated

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
    with pytest.raises(RunFailedError, match="observed in 13 keyframes"):
        map_points(sight.model, posed(sight), ALL.model_copy(update={"observations": 13}))
    with pytest.raises(RunFailedError, match="standard deviation of at most 1e-06 m"):
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


def prior(count, turn, shift):
    return np.repeat(np.diag(np.repeat(np.square((turn, shift)), 3))[None], count, axis=0)


def offsets(sight, cameras):
    """How far (F, 6) cameras are from the true ones, in their own frames."""
    true = sight.cameras
    pairs = zip(true.positions, true.rotations, cameras.positions, cameras.rotations, strict=True)
    return np.array([gtsam.Pose3.Logmap(pose3(p, r).between(pose3(q, s))) for p, r, q, s in pairs])


def test_wrong_poses_are_mended(look):
    rng = np.random.default_rng(0)
    sight = look(rng, noise=0.5)
    tracks, old = sight.tracks()
    wrong = sight.moved(rng, 0.01, 0.02)
    start = triangulate(sight.model, wrong, tracks)
    made = adjust(sight.model, wrong, prior(len(wrong), 0.01, 0.02), tracks, start.positions)
    before, after = np.abs(offsets(sight, wrong)).mean(axis=0), np.abs(offsets(sight, made.cameras)).mean(axis=0)
    assert np.all(after < 0.6 * before)
    assert np.sqrt(np.mean(made.errors**2)) < 0.6  # px
    error = np.linalg.norm(made.points - sight.points[old[made.old]], axis=1)
    assert np.median(error) < 0.5 * np.median(np.linalg.norm(start.positions - sight.points[old], axis=1))


def test_outliers_are_left_out(look):
    rng = np.random.default_rng(1)
    sight = look(rng, noise=0.5)
    tracks, old = sight.tracks()
    wrong = rng.random(len(tracks)) < 0.1
    pixels = tracks.pixels + np.where(wrong, 1.0, 0.0)[:, None] * rng.choice((-30.0, 30.0), (len(tracks), 2))
    spoilt = Tracks(tracks.track, tracks.frame, tracks.feature, pixels)
    start = triangulate(sight.model, sight.cameras, tracks).positions
    made = adjust(sight.model, sight.cameras, prior(len(sight.cameras), 0.002, 0.004), spoilt, start)
    assert abs(len(made.tracks) - np.count_nonzero(~wrong)) < 0.02 * len(tracks)
    assert np.abs(made.errors).max() < 3.5 * 0.5
    assert np.median(np.linalg.norm(made.points - sight.points[old[made.old]], axis=1)) < 0.01


def test_covariances_are_those_of_gtsam(look):
    sight = look(np.random.default_rng(2), count=5, points=20)
    tracks, old = sight.tracks()
    points, covariances = sight.points[old], prior(5, 0.01, 0.02)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(2, sight.model.sigma)
    for i in range(5):
        pose = pose3(sight.cameras.positions[i], sight.cameras.rotations[i])
        values.insert(X(i), pose)
        graph.add(gtsam.PriorFactorPose3(X(i), pose, gtsam.noiseModel.Gaussian.Covariance(covariances[i])))
    for k, point in enumerate(points):
        values.insert(L(k), point)
    calibration = sight.model.calibration()
    for k, i, pixel in zip(tracks.track.tolist(), tracks.frame.tolist(), tracks.pixels, strict=True):
        graph.add(gtsam.GenericProjectionFactorCal3DS2(pixel, noise, X(i), L(k), calibration))
    expected = gtsam.Marginals(graph, values)
    of_cameras, of_points = marginals(sight.model, sight.cameras, np.linalg.inv(covariances), tracks, points)
    for i in range(5):
        np.testing.assert_allclose(of_cameras[i], expected.marginalCovariance(X(i)), rtol=1e-5, atol=1e-10)
    for k in range(len(points)):
        np.testing.assert_allclose(of_points[k], expected.marginalCovariance(L(k)), rtol=1e-5, atol=1e-10)


def test_covariances_are_right(look):
    """Squared errors of cameras in units of their covariances, over scenes: bounds with 1 false alarm in 1000."""
    squared = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        sight = look(rng, count=6, points=60, noise=1.0)
        tracks, _ = sight.tracks()
        wrong = sight.moved(rng, 0.01, 0.02)
        start = triangulate(sight.model, wrong, tracks).positions
        made = adjust(sight.model, wrong, prior(6, 0.01, 0.02), tracks, start)
        error = offsets(sight, made.cameras)[0]  # one of each scene: the errors of its cameras go together
        squared.append(error @ np.linalg.solve(made.camera_covariances[0], error))
    low, high = chi2.ppf((0.0005, 0.9995), 6 * len(squared))
    assert low < np.sum(squared) < high


def test_the_focal_length_can_be_found(look):
    rng = np.random.default_rng(3)
    sight = look(rng, noise=0.3)
    tracks, _ = sight.tracks()
    wrong = recalibrated(sight.model, np.array((0, 0, 0, 0, 0, 0, 0.05, 0)))
    start = triangulate(wrong, sight.cameras, tracks).positions
    made = adjust(wrong, sight.cameras, prior(len(sight.cameras), 0.002, 0.004), tracks, start, focal=True)
    assert made.model.fx == pytest.approx(sight.model.fx, rel=0.01)
    assert made.model.fy == pytest.approx(sight.model.fy, rel=0.02)  # the cameras are side by side
    assert made.model.cx == pytest.approx(sight.model.cx, abs=0.1)


def test_the_lens_can_be_found(look):
    """Of a nominal camera: without it, cameras that agree with all pixels are bent away from their poses."""
    rng = np.random.default_rng(5)
    sight = look(rng, noise=0.3)
    tracks, _ = sight.tracks()
    nominal = replace(sight.model, fx=540.0, fy=540.0, cx=316.0, cy=243.0, distortion=(0.0, 0.0, 0.0, 0.0))
    start = triangulate(nominal, sight.cameras, tracks).positions
    given = (nominal, sight.cameras, prior(len(sight.cameras), 0.002, 0.004), tracks, start)
    bent, made = adjust(*given), adjust(*given, lens=True)
    seen = np.array([(x, y, 1.0) for x in (-0.4, 0.0, 0.4) for y in (-0.3, 0.0, 0.3)])
    apart = np.abs(project(made.model, seen) - project(sight.model, seen))
    assert apart.max() < 0.25 * np.abs(project(nominal, seen) - project(sight.model, seen)).max()
    assert np.median(np.abs(offsets(sight, made.cameras))) < 0.4 * np.median(np.abs(offsets(sight, bent.cameras)))


def test_without_noise_the_points_come_back(look):
    sight = look(np.random.default_rng(0), noise=0.0)
    tracks, old = sight.tracks()
    found = triangulate(sight.model, sight.cameras, tracks)
    np.testing.assert_allclose(found.positions, sight.points[old], atol=1e-6)
    assert np.abs(found.errors).max() < 1e-4
    assert found.good(tracks, sight.model).all()


def test_covariances_tell_how_far_points_are_off(look):
    """The mean of the squared errors in units of their covariances: false alarms in 1 of 1000 runs if it is right."""
    squared = []
    for seed in range(5):
        sight = look(np.random.default_rng(seed), noise=0.8)
        tracks, old = sight.tracks()
        found = triangulate(sight.model, sight.cameras, tracks)
        error = found.positions - sight.points[old]
        squared += np.einsum("ti,tij,tj->t", error, np.linalg.inv(found.covariances), error).tolist()
    # Huber's loss at 2 sigma loses about 1 % of efficiency, and the far points' errors are not quite Gaussian: 4 % of margin
    low, high = chi2.ppf((0.0005, 0.9995), 3 * len(squared)) / len(squared)
    assert 0.96 * low < np.mean(squared) < 1.04 * high


def test_a_wrong_observation_pulls_little(look):
    sight = look(np.random.default_rng(1), noise=0.5, points=40)
    tracks, old = sight.tracks()
    pixels = tracks.pixels.copy()
    first = np.unique(tracks.track, return_index=True)[1]
    pixels[first] += 40.0
    found = triangulate(sight.model, sight.cameras, Tracks(tracks.track, tracks.frame, tracks.feature, pixels))
    assert np.median(np.linalg.norm(found.positions - sight.points[old], axis=1)) < 0.03  # m; least squares: about 0.1


def test_rays_that_are_nearly_parallel_give_no_point(look):
    sight = look(np.random.default_rng(2), arc=0.001, noise=0.3)
    tracks, _ = sight.tracks()
    found = triangulate(sight.model, sight.cameras, tracks)
    assert np.isfinite(found.positions).all()
    assert not found.good(tracks, sight.model).any()


def test_points_behind_a_camera_are_refused(look):
    sight = look(np.random.default_rng(3), noise=0.0)
    tracks, _ = sight.tracks()
    turned = Cameras(sight.cameras.positions, sight.cameras.rotations @ np.diag((-1.0, 1.0, -1.0)))
    assert not triangulate(sight.model, turned, tracks).good(tracks, sight.model).any()


def test_parallax_is_the_greatest_angle():
    cameras = Cameras(
        np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.2, 0.0, 0.0)]), np.repeat(np.eye(3)[None], 3, axis=0)
    )
    none = np.zeros((3, 2))
    tracks = Tracks(np.zeros(3, dtype=int), np.arange(3), np.zeros(3, dtype=int), none)
    assert parallax(cameras, np.array([(0.0, 0.0, 1.0)]), tracks)[0] == pytest.approx(np.pi / 4)

"""Bundle adjustment: wrong poses are mended, outliers left out, covariances are those of GTSAM and right."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from scipy.stats import chi2

from factorgraph_loc.mapping.bundle import adjust, marginals, pose3
from factorgraph_loc.mapping.triangulation import Tracks, triangulate
from factors.camera.model import project, recalibrated


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

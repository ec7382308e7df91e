"""Points from rays: exact without noise, honest about noise, and refused where rays are nearly parallel."""

import numpy as np
import pytest
from scipy.stats import chi2

from factorgraph_loc.mapping.triangulation import Cameras, Tracks, parallax, triangulate


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

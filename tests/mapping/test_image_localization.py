"""Images located in a map: one by one, and in one graph that also reaches where the map does not."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factorgraph_loc.mapping import bundle
from factorgraph_loc.mapping.feature_tracks import chained
from factorgraph_loc.mapping.image_localization import EPIPOLAR, ImageLocalizer, smooth_start
from factorgraph_loc.mapping.steady_motion import SteadyMotion, change_of_velocity
from factorgraph_loc.mapping.triangulation import Tracks, reproject
from factorgraph_loc.maps.points import PointMap
from factors.camera.model import project

pytestmark = pytest.mark.kernels

T = 0.1 * np.arange(12)


def a_map(sight, rng, known, sigma=0.002):
    """A map of the points ``known``, wrong by ``sigma`` [m], each seen from the middle."""
    looks = np.zeros((len(sight.points), 16), dtype=np.float32)
    for frame, shown in zip(sight.frames, sight.shown, strict=True):
        looks[shown] = frame.descriptors
    count = len(known)
    return PointMap(
        tuple(f"p{i}" for i in range(count)),
        sight.points[known] + sigma * rng.standard_normal((count, 3)),
        np.repeat(sigma**2 * np.eye(3)[None], count, axis=0),
        "sift",
        np.arange(count),
        looks[known],
        np.repeat(sight.cameras.positions[len(sight.frames) // 2][None], count, axis=0),
        np.full(count, 4.0),
    )


def errors(sight, places):
    return np.array([np.linalg.norm(p.position - c) for p, c in zip(places, sight.cameras.positions, strict=True)])


def test_images_are_located_one_by_one(look):
    rng = np.random.default_rng(0)
    sight = look(rng, noise=0.5)
    localizer = ImageLocalizer(a_map(sight, rng, np.arange(150)), sight.model)
    places = [localizer.one(frame) for frame in sight.frames]
    assert errors(sight, places).max() < 0.02
    place = places[3]
    shown = sight.shown[3][place.features]
    assert np.mean(shown == place.points) > 0.98  # points of the map have the numbers of the true ones here
    error = sight.cameras.rotations[3].T @ (place.position - sight.cameras.positions[3])
    assert np.all(np.abs(error) < 5.0 * np.sqrt(np.diag(place.covariance)[3:]) + 1e-3)


def test_an_image_of_elsewhere_is_not_located(look):
    rng = np.random.default_rng(1)
    sight = look(rng)
    localizer = ImageLocalizer(a_map(sight, rng, np.arange(150)), sight.model)
    frame = sight.frames[0]
    other = replace(frame, descriptors=rng.standard_normal(frame.descriptors.shape).astype(np.float32))
    assert localizer.one(other) is None
    assert localizer.all([other] * 3, T[:3], [None] * 3) == [None] * 3


def test_the_graph_is_better_than_single_images(look):
    rng = np.random.default_rng(2)
    sight = look(rng, noise=1.0)
    localizer = ImageLocalizer(a_map(sight, rng, rng.choice(150, 40, replace=False)), sight.model)
    one = [localizer.one(frame) for frame in sight.frames]
    both = localizer.all(sight.frames, T, one)
    assert np.mean(errors(sight, both)) < 0.7 * np.mean(errors(sight, one))


def reaching_beyond(sight, known):
    """The frames of a sight, of which those from the ninth on show none of the ``known`` points."""
    frames = []
    for i, (frame, shown) in enumerate(zip(sight.frames, sight.shown, strict=True)):
        keep = ~np.isin(shown, known) if i >= 8 else np.ones(len(shown), dtype=bool)
        frames.append(
            replace(frame, pixels=frame.pixels[keep], sizes=frame.sizes[keep], descriptors=frame.descriptors[keep])
        )
    return frames


def test_the_graph_reaches_beyond_the_map(look):
    """The last images see nothing of the map, but points that the images before them see too."""
    rng = np.random.default_rng(3)
    sight = look(rng, noise=0.5)
    known = np.arange(0, 150, 2)
    frames = reaching_beyond(sight, known)
    localizer = ImageLocalizer(a_map(sight, rng, known), sight.model)
    ones = [localizer.one(frame) for frame in frames]
    assert ones[8:] == [None] * 4
    places = localizer.all(frames, T, ones)
    assert errors(sight, places).max() < 0.03


def test_wrong_tracks_do_not_pull_images_that_see_nothing_of_the_map(look, monkeypatch):
    """Features of the last images, of other points, are in tracks of points of the map as well."""
    rng = np.random.default_rng(3)
    sight = look(rng, noise=0.5)
    known = np.arange(0, 150, 2)
    frames = reaching_beyond(sight, known)
    localizer = ImageLocalizer(a_map(sight, rng, known), sight.model)
    ones = [localizer.one(frame) for frame in frames]
    of_map = ones[0].features

    def with_wrong_ones(*given):
        right = chained(*given)
        wrong = []
        for k, feature in enumerate(of_map):  # what is 150 px beside the point, in all these images
            for i in range(8, 12):
                local = (sight.points[sight.shown[0][feature]] - sight.cameras.positions[i]) @ sight.cameras.rotations[
                    i
                ]
                aside = np.linalg.norm(frames[i].pixels - project(sight.model, local[None]) - (150.0, 0.0), axis=1)
                wrong.append((k, i, int(aside.argmin())))
        track, frame, feature = np.concatenate((np.array([(k, 0, f) for k, f in enumerate(of_map)]), wrong)).T
        pixels = np.array([frames[i].pixels[f] for i, f in zip(frame, feature, strict=True)])
        both = (
            (right.track, right.count + track),
            (right.frame, frame),
            (right.feature, feature),
            (right.pixels, pixels),
        )
        return Tracks(*(np.concatenate(part) for part in both))

    monkeypatch.setattr("factorgraph_loc.mapping.image_localization.chained", with_wrong_ones)
    adjust, amiss = bundle.adjust, []

    def watched(model, cameras, covariances, tracks, points, *, known=None, **others):
        if known is not None:
            off = np.linalg.norm(reproject(model, cameras, points, tracks)[0], axis=1)
            amiss.append(np.count_nonzero(off[np.isin(tracks.track, known.points)] > EPIPOLAR))
        return adjust(model, cameras, covariances, tracks, points, known=known, **others)

    monkeypatch.setattr("factorgraph_loc.mapping.bundle.adjust", watched)
    assert errors(sight, localizer.all(frames, T, ones)).max() < 0.03
    assert amiss == [0, 0]


def test_a_start_for_all_images(look):
    rng = np.random.default_rng(4)
    sight = look(rng, noise=0.2)
    localizer = ImageLocalizer(a_map(sight, rng, np.arange(150)), sight.model)
    places = [localizer.one(sight.frames[i]) if i in (2, 4) else None for i in range(6)]
    start = smooth_start(T[:6], places)
    np.testing.assert_allclose(start.positions[3], 0.5 * (places[2].position + places[4].position))
    np.testing.assert_array_equal(start.positions[0], places[2].position)
    np.testing.assert_allclose(start.rotations[5], places[4].rotation, atol=1e-9)
    assert smooth_start(T[:6], [places[2], *[None] * 5]) is None


def poses(rng):
    return [gtsam.Pose3.Expmap(0.4 * rng.standard_normal(6)) for _ in range(3)]


def test_jacobians_of_the_change_of_velocity():
    first, second, third = poses(np.random.default_rng(5))
    _, blocks = change_of_velocity(first, second, third, 1.3)
    for i, block in enumerate(blocks):
        for k in range(6):
            step = 1e-6 * np.eye(6)[k]
            values = []
            for sign in (1.0, -1.0):
                moved = [first, second, third]
                moved[i] = moved[i].compose(gtsam.Pose3.Expmap(sign * step))
                values.append(change_of_velocity(*moved, 1.3)[0])
            np.testing.assert_allclose(block[:, k], (values[0] - values[1]) / 2e-6, atol=1e-6)


def test_constant_velocity_is_no_change():
    start, twist = poses(np.random.default_rng(6))[0], np.array((0.1, -0.2, 0.05, 0.3, 0.1, -0.2))
    second = start.compose(gtsam.Pose3.Expmap(twist))
    third = second.compose(gtsam.Pose3.Expmap(2.0 * twist))
    np.testing.assert_allclose(change_of_velocity(start, second, third, 2.0)[0], 0.0, atol=1e-12)


@pytest.mark.parametrize(("t", "factors"), [([0.0, 0.1, 0.2, 0.3], 2), ([0.0, 0.1, 0.9, 1.0], 0), ([0.0, 0.1], 0)])
def test_gaps_are_not_bridged(t, factors):
    graph = gtsam.NonlinearFactorGraph()
    SteadyMotion(np.array(t)).add_to(graph)
    assert graph.size() == factors


def test_a_graph_that_cannot_be_solved_leaves_single_images(look, monkeypatch):
    rng = np.random.default_rng(7)
    sight = look(rng, noise=0.5, count=4)
    localizer = ImageLocalizer(a_map(sight, rng, np.arange(150)), sight.model)

    def fails(*_, **__):
        raise RuntimeError("Indeterminant linear system")

    monkeypatch.setattr("factorgraph_loc.mapping.bundle.adjust", fails)
    ones = [localizer.one(frame) for frame in sight.frames]
    assert localizer.all(sight.frames, T[:4], ones) == ones

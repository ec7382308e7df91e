"""Repeatability: areas against closed forms and pixels, scores of points that are moved by known amounts, the level of chance."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorgraph_loc.evaluation.features.feature_evaluation import Feature, evaluate, match_scores
from factorgraph_loc.evaluation.features.repeatability import (
    OVERLAP_ERROR,
    RADIUS,
    SCALE_RATIO,
    overlaps,
    pair_errors,
    repeatability,
    shared_area,
)
from factorgraph_loc.evaluation.features.sequences import SCALE, Sequence, find_sequences, project
from factorgraph_loc.vision.features import Keypoints, extractor
from factorgraph_loc.vision.matching import Matches

SHAPE = (480, 640)
SHAPES = (SHAPE, SHAPE)
ZOOM = np.array(((0.5, 0.0, 80.0), (0.0, 0.5, 60.0), (0.0, 0.0, 1.0)))


def points_at(points, sizes):
    n = len(points)
    nothing = np.zeros(n)
    return Keypoints(np.array(points, dtype=float), np.broadcast_to(sizes, n).astype(float), nothing, nothing)


def scattered(count, rng, low=4.0, high=5.0):
    return points_at(rng.uniform((20.0, 20.0), (620.0, 460.0), (count, 2)), rng.uniform(low, high, count))


def lens(distance):
    """The area that two unit discs share."""
    half = distance / 2.0
    return 2.0 * np.arccos(half) - distance * np.sqrt(1.0 - half**2)


@given(st.integers(0, 10_000))
def test_shared_area_of_ellipses_is_that_of_pixels(seed):
    rng = np.random.default_rng(seed)
    axes = np.diag(rng.uniform(0.4, 2.0, 2))
    angle = rng.uniform(0.0, np.pi)
    turn = np.array(((np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))))
    shape, centre = turn @ axes**2 @ turn.T, rng.uniform(-1.0, 1.0, 2)
    x, y = np.meshgrid(*2 * [np.linspace(-1.0, 1.0, 400)])
    grid = np.stack((x, y), axis=-1)
    to_centre = grid - centre
    both = ((grid**2).sum(-1) <= 1.0) & (np.einsum("...i,ij,...j", to_centre, np.linalg.inv(shape), to_centre) <= 1.0)
    assert shared_area(centre[None], shape[None]) == pytest.approx(both.mean() * 4.0, abs=0.02)


def test_overlap_error_is_that_of_magnified_discs():
    first, second = points_at([(100.0, 100.0)], 4.0), points_at([(109.0, 100.0)], 4.0)
    shared = lens(9.0 / RADIUS)
    assert pair_errors(first, second, np.eye(3)) == pytest.approx(1.0 - shared / (2.0 * np.pi - shared), abs=0.003)
    # three times the radius of 2 px: discs of 6 px that are 9 px apart
    shared = lens(9.0 / 6.0)
    assert pair_errors(first, second, np.eye(3), magnified=False) == pytest.approx(
        1.0 - shared / (2.0 * np.pi - shared), abs=0.003
    )


@given(zoom=st.floats(0.3, 3.0), angle=st.floats(-3.0, 3.0), ratio=st.floats(0.8, 1.25))
def test_a_region_that_is_seen_by_another_camera_is_the_same_region(zoom, angle, ratio):
    c, s = zoom * np.cos(angle), zoom * np.sin(angle)
    homography = np.array(((c, -s, 7.0), (s, c, -3.0), (0.0, 0.0, 1.0)))
    first = points_at([(50.0, 60.0)], 5.0)
    second = points_at(project(homography, first.points), 5.0 * zoom * ratio)
    expected = 1.0 - min(ratio, 1.0 / ratio) ** 2
    assert pair_errors(first, second, homography) == pytest.approx(expected, abs=0.003)


def test_no_pair_is_missed():
    """The search by distance and size finds all pairs below the limit that comparing each with each does."""
    rng = np.random.default_rng(2)
    tilted = np.array(((0.9, -0.2, 60.0), (0.1, 0.8, 20.0), (2e-4, 1e-4, 1.0)))
    places = rng.uniform(100.0, 200.0, (2, 150, 2))
    first, second = points_at(places[0], rng.uniform(2, 9, 150)), points_at(places[1], rng.uniform(2, 9, 150))
    for magnified in (True, False):
        i, j = (index.ravel() for index in np.mgrid[:150, :150])
        error = pair_errors(first[i], second[j], tilted, magnified=magnified)
        every = set(zip(i[error < OVERLAP_ERROR].tolist(), j[error < OVERLAP_ERROR].tolist(), strict=True))
        pairs = overlaps(first, second, tilted, magnified=magnified)
        close = pairs.error < OVERLAP_ERROR
        assert set(zip(pairs.first[close].tolist(), pairs.second[close].tolist(), strict=True)) == every
        assert every


def test_only_the_common_part_counts():
    first = points_at([(100.0, 100.0), (300.0, 200.0), (500.0, 400.0)], 8.0)
    seen = points_at(project(ZOOM, first.points), 4.0)
    # two more where only the second image looks
    second = points_at([*seen.points, (5.0, 5.0), (600.0, 470.0)], 4.0)
    found = repeatability(first, second, ZOOM, SHAPES)
    assert (found.regions, found.repeatability, found.strict) == (3, 1.0, 1.0)


def test_the_strict_score_rejects_other_places_and_sizes():
    grid = [(x, y) for x in range(100, 600, 100) for y in range(100, 400, 100)]
    first = points_at(grid, 4.0)
    moved = points_at([(x + 7.0, y) for x, y in grid], 4.0)
    found = repeatability(first, moved, np.eye(3), SHAPES)
    assert (found.repeatability, found.strict) == (1.0, 0.0)
    grown = points_at(grid, 4.0 * (SCALE_RATIO + 0.04))
    found = repeatability(first, grown, np.eye(3), SHAPES)
    assert (found.repeatability, found.strict) == (1.0, 0.0)
    larger = points_at(grid, 4.0 * 1.4)
    found = repeatability(first, larger, np.eye(3), SHAPES)
    assert (found.repeatability, found.strict) == (0.0, 0.0)


def test_several_orientations_are_one_region():
    once = scattered(30, np.random.default_rng(6))
    twice = once[np.repeat(np.arange(30), 2)]
    found = repeatability(twice, twice, np.eye(3), SHAPES)
    assert (found.regions, found.repeatability, found.strict) == (30, 1.0, 1.0)


def test_the_level_of_chance():
    """1,000 random points with the sizes of real ones: what every score has to be read against."""
    rng = np.random.default_rng(8)
    sizes = 3.5 * rng.exponential(0.7, (2, 1000)) + 3.0
    first, second = (points_at(rng.uniform((0.0, 0.0), (799.0, 639.0), (1000, 2)), row) for row in sizes)
    found = repeatability(first, second, np.eye(3), ((640, 800), (640, 800)))
    assert 0.15 < found.repeatability < 0.35
    assert found.strict < 0.1


@pytest.mark.parametrize(
    ("name", "anchors"),
    [("bark", (0.73, 0.74, 0.84, 0.76, 0.79)), ("boat", (0.71, 0.61, 0.32, 0.25, 0.13))],
)
def test_sift_repeats_as_it_is_known_to(data_root, name, anchors):
    """Another evaluation of the same images, with its own one-to-one rule; pairs of bark share fewer than 100 regions."""
    (sequence,) = find_sequences([data_root / "oxford_affine" / name])
    sift = extractor("sift", 1000)
    first, *others = (sift.detect(image) for image in (sequence.first, *sequence.others))
    found = [
        repeatability(first, other, homography, (sequence.first.shape, image.shape)).repeatability
        for other, homography, image in zip(others, sequence.homographies, sequence.others, strict=True)
    ]
    assert found == pytest.approx(anchors, abs=0.11)
    assert np.mean(found) == pytest.approx(np.mean(anchors), abs=0.04)


HALF = np.array(((0.5, 0.0, 80.0), (0.0, 0.5, 60.0), (0.0, 0.0, 1.0)))
IMAGE = np.zeros(SHAPE, dtype=np.uint8)


def keypoints(points, sizes=6.0):
    n = len(points)
    return Keypoints(np.array(points, dtype=float), np.full(n, sizes), np.zeros(n), np.zeros(n))


def pair(homography=HALF, image=IMAGE):
    return Sequence("made", IMAGE, (image,), (homography,), SCALE, (2.0,))


def made(points, descriptors, seen, seen_descriptors):
    """A feature that finds ``points`` first (twice: once to warm up) and ``seen`` then."""
    answers = iter([(points, descriptors)] * 2 + [(seen, seen_descriptors)])
    return Feature("made", lambda _: next(answers))


def test_a_perfect_feature_scores_one():
    rng = np.random.default_rng(1)
    points = keypoints(rng.uniform((30.0, 30.0), (600.0, 450.0), (60, 2)))
    seen = keypoints(project(HALF, points.points), 3.0)
    vectors = rng.normal(size=(60, 16)).astype(np.float32)
    (scores,) = evaluate(pair(), made(points, vectors, seen, vectors))
    perfect = ("repeatability", "strict", "matching_score", "precision")
    assert {name: scores[name] for name in perfect} == pytest.approx(dict.fromkeys(perfect, 1.0))
    assert (scores["features"], scores["regions"], scores["matches"], scores["image"], scores["amount"]) == (
        60,
        60,
        60,
        2,
        2.0,
    )


def test_wrong_matches_cost_precision():
    rng = np.random.default_rng(2)
    grid = [(x, y) for x in range(60, 600, 90) for y in range(60, 450, 90)]
    points, n = keypoints(grid), len(grid)
    seen = keypoints(project(HALF, points.points), 3.0)
    vectors = rng.normal(size=(n, 16)).astype(np.float32)
    swapped = np.arange(n)
    swapped[:6] = np.roll(swapped[:6], 1)
    (scores,) = evaluate(pair(), made(points, vectors, seen, vectors[swapped]))
    assert scores["precision"] == scores["matching_score"] == pytest.approx(1.0 - 6.0 / n)


def test_matches_out_of_the_common_part_are_wrong():
    first, second = keypoints([(100.0, 100.0), (320.0, 240.0)]), keypoints([(5.0, 5.0), (240.0, 180.0)], 3.0)
    both = Matches(np.array(((0, 0), (1, 1))), np.zeros(2))
    found = match_scores(first, second, both, both, HALF, (SHAPE, SHAPE))
    assert (found.matching_score, found.precision) == (1.0, 0.5)


def test_detectors_have_no_matching_scores():
    image = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 255, SHAPE).astype(np.uint8), (0, 0), 2.0)
    sequence = Sequence("same", image, (image,), (np.eye(3),), SCALE, (1.0,))
    steps, sift = [], extractor("sift", 50)
    (scores,) = evaluate(sequence, Feature("dog", lambda image: (sift.detect(image), None)), lambda: steps.append(1))
    assert len(steps) == 2
    assert np.isnan(scores["matching_score"])
    assert scores["repeatability"] == 1.0
    assert scores["milliseconds"] > 0.0


@pytest.mark.parametrize(("name", "score", "precision"), [("sift", 0.58, 0.92), ("orb", 0.41, 0.90)])
def test_opencv_features_match_as_well_as_they_are_known_to(data_root, name, score, precision):
    (graf,) = find_sequences([data_root / "oxford_affine" / "graf"])
    two = Sequence(graf.name, graf.first, graf.others[:2], graf.homographies[:2], graf.change, graf.amounts[:2])
    found = list(evaluate(two, Feature(name, extractor(name, 1000).detectAndCompute)))
    assert np.mean([scores["matching_score"] for scores in found]) == pytest.approx(score, abs=0.1)
    assert np.mean([scores["precision"] for scores in found]) == pytest.approx(precision, abs=0.05)

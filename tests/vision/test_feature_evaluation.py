"""The scores of features: hand-made matches, features that match by construction, homographies of known error."""

import cv2
import numpy as np
import pytest

from factorgraph_loc.evaluation.features.feature_evaluation import (
    Feature,
    evaluate,
    feature,
    match_scores,
    mutual_matches,
)
from factorgraph_loc.evaluation.features.sequences import SCALE, Sequence, find_sequences, project
from factorgraph_loc.vision.features import Keypoints, extractor
from factorgraph_loc.vision.matching import RATIO, match

SHAPE = (480, 640)
HALF = np.array(((0.5, 0.0, 80.0), (0.0, 0.5, 60.0), (0.0, 0.0, 1.0)))
IMAGE = np.zeros(SHAPE, dtype=np.uint8)


def keypoints(points, sizes=6.0):
    n = len(points)
    return Keypoints(
        np.array(points, dtype=float), np.full(n, sizes), np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.int64)
    )


def pair(homography=HALF, image=IMAGE):
    return Sequence("made", IMAGE, (image,), (homography,), SCALE, (2.0,))


def made(points, descriptors, seen, seen_descriptors):
    """A feature that finds ``points`` first (twice: once to warm up) and ``seen`` then."""
    answers = iter([(points, descriptors)] * 2 + [(seen, seen_descriptors)])
    return Feature("made", lambda _: next(answers))


def test_mutual_matches_of_bits_and_of_too_few():
    first = np.array(((0b1111,), (0b0000,)), dtype=np.uint8)
    second = np.array(((0b0001,), (0b1110,)), dtype=np.uint8)
    i, j, ratio = mutual_matches(first, second)
    assert (i.tolist(), j.tolist()) == ([0, 1], [1, 0])
    assert ratio == pytest.approx((1 / 3, 1 / 3))
    assert mutual_matches(first[:1], second[:1])[2].tolist() == [0.0]
    assert len(mutual_matches(first[:0], second)[0]) == len(mutual_matches(first, second[:0])[0]) == 0


@pytest.mark.parametrize("binary", [False, True])
def test_clear_matches_are_those_of_the_product(binary):
    rng = np.random.default_rng(6)
    if binary:
        first = rng.integers(0, 255, (80, 8)).astype(np.uint8)
        flipped = rng.random((50, 8, 8)) < rng.uniform(0.05, 0.5, (50, 1, 1))
        second = first[:50] ^ np.packbits(flipped, axis=2)[:, :, 0]
    else:
        first = rng.normal(size=(80, 8)).astype(np.float32)
        second = first[:50] + rng.normal(0.0, 0.4, (50, 8)).astype(np.float32)
    i, j, ratio = mutual_matches(first, second)
    for limit in (0.6, RATIO):
        expected = match(first, second, binary=binary, ratio=limit)
        assert np.column_stack((i, j))[ratio < limit].tolist() == expected.indices.tolist()
        assert 0 < len(expected) < 50


def test_equal_descriptors_have_no_clear_match():
    same = np.ones((3, 4), dtype=np.float32)
    assert mutual_matches(same, same)[2].tolist() == [1.0]


def test_a_perfect_feature_scores_one():
    rng = np.random.default_rng(1)
    points = keypoints(rng.uniform((30.0, 30.0), (600.0, 450.0), (60, 2)))
    seen = keypoints(project(HALF, points.points), 3.0)
    vectors = rng.normal(size=(60, 16)).astype(np.float32)
    (scores,) = evaluate(pair(), made(points, vectors, seen, vectors))
    row = scores.row()
    perfect = ("repeatability", "strict", "matching_score", "precision")
    assert {name: row[name] for name in perfect} == pytest.approx(dict.fromkeys(perfect, 1.0))
    assert (row["features"], row["regions"], row["matches"], row["image"], row["amount"]) == (60, 60, 60, 2, 2.0)


def test_wrong_matches_cost_precision():
    rng = np.random.default_rng(2)
    grid = [(x, y) for x in range(60, 600, 90) for y in range(60, 450, 90)]
    points, n = keypoints(grid), len(grid)
    seen = keypoints(project(HALF, points.points), 3.0)
    vectors = rng.normal(size=(n, 16)).astype(np.float32)
    swapped = np.arange(n)
    swapped[:6] = np.roll(swapped[:6], 1)
    (scores,) = evaluate(pair(), made(points, vectors, seen, vectors[swapped]))
    assert scores.matching.precision == scores.matching.matching_score == pytest.approx(1.0 - 6.0 / n)


def test_matches_out_of_the_common_part_are_wrong():
    first, second = keypoints([(100.0, 100.0), (320.0, 240.0)]), keypoints([(5.0, 5.0), (240.0, 180.0)], 3.0)
    both = np.array((0, 1))
    found = match_scores(first, second, (both, both, np.array((0.1, 0.2))), HALF, (SHAPE, SHAPE))
    assert (found.matching_score, found.precision) == (1.0, 0.5)


def test_detectors_have_no_matching_scores():
    image = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 255, SHAPE).astype(np.uint8), (0, 0), 2.0)
    sequence = Sequence("same", image, (image,), (np.eye(3),), SCALE, (1.0,))
    steps = []
    (scores,) = evaluate(sequence, feature("fast_hessian", 50), lambda: steps.append(1))
    assert len(steps) == 2
    assert np.isnan(scores.matching.matching_score)
    assert scores.repeatability.repeatability == 1.0
    assert scores.milliseconds > 0.0


@pytest.mark.parametrize(("name", "score", "precision"), [("sift", 0.58, 0.92), ("orb", 0.41, 0.90)])
def test_opencv_features_match_as_well_as_they_are_known_to(data_root, name, score, precision):
    (graf,) = find_sequences([data_root / "oxford_affine" / "graf"])
    two = Sequence(graf.name, graf.first, graf.others[:2], graf.homographies[:2], graf.change, graf.amounts[:2])
    found = [scores.matching for scores in evaluate(two, Feature(name, extractor(name, 1000).detectAndCompute))]
    assert np.mean([s.matching_score for s in found]) == pytest.approx(score, abs=0.1)
    assert np.mean([s.precision for s in found]) == pytest.approx(precision, abs=0.05)

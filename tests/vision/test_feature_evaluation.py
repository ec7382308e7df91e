"""The scores of features: hand-made matches, features that match by construction, homographies of known error."""

import cv2
import numpy as np
import pytest

from factorgraph_loc.evaluation.features.feature_evaluation import (
    Feature,
    evaluate,
    match_scores,
)
from factorgraph_loc.evaluation.features.sequences import SCALE, Sequence, find_sequences, project
from factorgraph_loc.vision.features import Keypoints, extractor
from factorgraph_loc.vision.matching import Matches

SHAPE = (480, 640)
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

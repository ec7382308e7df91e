"""Alignment on cases whose answer is known, against the evo package, and the figures of a free map."""

import math
from dataclasses import replace

import numpy as np
import pytest
from evo.core.geometry import umeyama_alignment
from scipy.stats import chi2

from factorgraph_loc import Landmark, Log, Rig, Trajectory, World
from factorgraph_loc.evaluation.metrics import landmark_figures
from factorgraph_loc.evaluation.pairing import align_points, pairs
from factorgraph_loc.model.belief import LearntPoint
from factors import se2

FRAME = np.array((4.0, -3.0, 2.5))  # of the world in the estimate's frame
SIGMA = np.array(((0.04, 0.015), (0.015, 0.01)))


def arc():
    t = np.arange(50) * 0.1
    return Trajectory(t, np.stack((np.cos(t), 2.0 * np.sin(t), se2.wrap(t)), axis=1))


def align(estimate, truth):
    pair = pairs(estimate, truth)
    return align_points(pair.poses[:, :2], pair.truth[:, :2])


def free_map(n, rng):
    """A log with ``n`` landmarks and what an estimator with a frame of its own learnt of them, with random errors."""
    places = rng.uniform(-10.0, 10.0, (n, 2))
    world = World(landmarks={f"L{i}": Landmark(x=x, y=y) for i, (x, y) in enumerate(places.tolist())})
    learnt = se2.transform_from(FRAME, places) + rng.multivariate_normal(np.zeros(2), SIGMA, n)
    points = {f"L{i}": LearntPoint(p, SIGMA) for i, p in enumerate(learnt)}
    return Log("log", Rig(), world, {}, arc()), points, replace(arc(), poses=se2.compose(FRAME, arc().poses))


def test_least_squares_are_those_of_evo():
    rng = np.random.default_rng(4)
    points, targets = rng.normal(size=(2, 40, 2))
    pose = align_points(points, targets)
    rotation, translation, _ = umeyama_alignment(points.T, targets.T, with_scale=False)
    np.testing.assert_allclose(pose, (*translation, math.atan2(rotation[1, 0], rotation[0, 0])), atol=1e-12)


def test_pairs_without_a_reference_are_left_out():
    truth = arc()
    seen = Trajectory(truth.t[:30], truth.poses[:30])
    poses = se2.compose(FRAME, truth.poses)
    poses[30:] += 100.0
    np.testing.assert_allclose(align(Trajectory(truth.t, poses), seen), se2.inverse(FRAME), atol=1e-12)
    assert np.isnan(align(Trajectory(truth.t + 100.0, poses), seen)).all()
    np.testing.assert_array_equal(align_points(np.ones((3, 2)), np.zeros((3, 2))), (-1.0, -1.0, 0.0))


@pytest.mark.parametrize("with_reference", [True, False])
def test_errors_of_a_map_are_those_of_its_covariances(with_reference):
    """Independent errors: ANEES and RMSE leave their intervals in one of 10^5 correct implementations; aligned by the landmarks
    themselves three degrees of freedom of 2000 are lost, which is less than a tenth of the interval."""
    n = 1000
    log, points, trajectory = free_map(n, np.random.default_rng(5))
    figures = landmark_figures(trajectory, points, log if with_reference else replace(log, reference=None))
    assert figures["landmarks.count"] == n
    low, high = chi2.ppf((5e-6, 1.0 - 5e-6), 2 * n) / n
    assert low < figures["landmarks.anees"] < high
    expected = np.sum(np.linalg.eigvalsh(SIGMA))
    spread = 4.42 * math.sqrt(2.0 * np.sum(np.linalg.eigvalsh(SIGMA) ** 2) / n)
    assert abs(figures["landmarks.rmse"] ** 2 - expected) < spread


def test_landmarks_that_the_map_lacks_and_covariances_that_are_none():
    log, points, trajectory = free_map(4, np.random.default_rng(6))
    points |= {"new": LearntPoint(np.zeros(2), SIGMA), "L0": replace(points["L0"], covariance=np.zeros((2, 2)))}
    figures = landmark_figures(trajectory, points, log)
    assert figures["landmarks.count"] == 4
    own = np.array(
        [points[f"L{i}"].position - se2.transform_from(FRAME, log.world.position(f"L{i}")) for i in (1, 2, 3)]
    )
    assert figures["landmarks.anees"] == pytest.approx(np.mean([e @ np.linalg.inv(SIGMA) @ e for e in own]))
    figures = landmark_figures(trajectory, {}, replace(log, reference=replace(log.reference, has_heading=False)))
    assert figures["landmarks.rmse"] is figures["landmarks.anees"] is None

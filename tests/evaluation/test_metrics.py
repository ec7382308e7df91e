"""Figures on cases whose answer is known, and against the evo package."""

import math
from dataclasses import replace

import numpy as np
import pytest
from drives import driven
from evo.core import metrics as evo
from evo.core.geometry import umeyama_alignment
from evo.core.trajectory import PosePath3D
from scipy.stats import binom, chi2

from factorgraph_loc import Landmark, Log, Rig, Trajectory, World
from factorgraph_loc.evaluation.metrics import accuracy, errors, landmark_figures, score
from factorgraph_loc.evaluation.pairing import Pairs, pairs
from factorgraph_loc.evaluation.scores import OF_FREE_MAP
from factorgraph_loc.evaluation.trajectories.association import in_plane
from factorgraph_loc.evaluation.trajectories.score import pose_errors
from factorgraph_loc.model.belief import Learnt, LearntPoint
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.result import RunResult, Timings
from factors import se2

NOTHING, NOTHING_LEARNT, NO_CONFIG = Diagnostics(), Learnt(), {}
TIMINGS = Timings(np.array([0.5]), np.array([2.0]), 1.0, 10.0, 0.1, 100.0)


def drive(n=600, dt=0.1, speed=0.4):
    """A wandering drive, and an estimate of it that drifts."""
    rng = np.random.default_rng(1)
    t = np.arange(n) * dt
    twists = np.stack((np.full(n, speed * dt), np.zeros(n), 0.04 * np.sin(t / 7.0)), axis=1)
    off = 0.005 * rng.standard_normal((n - 1, 3))
    truth = driven(se2.exp(twists[1:]), (1.0, 2.0, 3.0))
    return t, truth, driven(se2.exp(twists[1:] + off), (1.02, 1.97, 3.05))


def result_of(t, poses, status, diagnostics=NOTHING, learnt=NOTHING_LEARNT, config=NO_CONFIG):
    covariances = np.tile(np.eye(3), (len(t), 1, 1))
    final = Trajectory(t, poses, covariances)
    return RunResult("log", config, t, poses, covariances, status, final, diagnostics, learnt, TIMINGS)


def test_in_a_gap_of_the_reference_nothing_is_scored():
    reference = Trajectory(np.array([0.0, 0.1, 0.2, 1.2, 1.3]), np.zeros((5, 3)))
    t = np.arange(14) * 0.1
    poses = np.zeros((14, 3))
    poses[3:12, 0] = 100.0
    figures = accuracy(Trajectory(t, poses), reference)
    assert figures["position_max"] == pytest.approx(0.0, abs=1e-9)
    assert figures["scored"] == 5


def test_no_relative_error_spans_a_gap():
    poses = np.stack((np.arange(8) * 0.6, np.zeros(8), np.zeros(8)), axis=1)
    missing = poses.copy()
    missing[3] = np.nan

    def pieces(t, estimate, reference):
        both = [Trajectory(t, poses) for poses in (estimate, reference)]
        return len(pose_errors(in_plane(Pairs(t, estimate, None, reference), *both))[1].position)

    t = 0.1 * np.arange(8)
    # 0..2 holds one piece of 1.2 m, 4..7 one more; the rest is too short
    assert pieces(t, poses, missing) == 2
    assert pieces(t, missing, poses) == 2
    assert pieces(t + 9.0 * (t > 0.35), poses, poses) == 2
    assert pieces(t, poses, poses) == 3


def test_heading_is_not_scored_where_the_reference_has_none():
    t, truth, estimate = drive()
    covariances = np.tile(np.diag((1.0, 1.0, 1e-9)), (len(t), 1, 1))
    figures = accuracy(Trajectory(t, estimate, covariances), Trajectory(t, truth, has_heading=False))
    assert figures["heading_rmse"] is None
    assert figures["rpe_position_per_m"] is None
    assert figures["rpe_heading_per_m"] is None
    assert figures["anees"] == pytest.approx(np.mean(np.sum((estimate - truth)[:, :2] ** 2, axis=1)))


def test_nees_of_a_known_covariance():
    t = np.arange(4) * 0.1
    covariances = np.tile(np.array([(4.0, 1.0, 0.0), (1.0, 2.0, 0.1), (0.0, 0.1, 0.5)]), (4, 1, 1))
    difference = np.array((1.0, -2.0, 0.3))
    expected = difference @ np.linalg.inv(covariances[0]) @ difference
    figures = accuracy(Trajectory(t, np.tile(difference, (4, 1)), covariances), Trajectory(t, np.zeros((4, 3))))
    assert figures["anees"] == pytest.approx(expected)
    assert figures["nees_bounds"] == pytest.approx([chi2.ppf(0.025, 12) / 4, chi2.ppf(0.975, 12) / 4])


def test_a_covariance_that_is_none_is_counted_and_left_out():
    t = np.arange(3) * 0.1
    covariances = np.stack((np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan)))
    figures = accuracy(Trajectory(t, np.ones((3, 3)) * 0.1, covariances), Trajectory(t, np.zeros((3, 3))))
    assert figures["invalid_covariances"] == 2
    assert figures["anees"] == pytest.approx(0.03)


def test_errors_drawn_from_the_covariance_are_consistent():
    """Independent errors: ANEES and coverage fall outside their intervals in one of 10^6 correct implementations."""
    n = 5000
    rng = np.random.default_rng(3)
    covariance = np.array([(0.04, 0.01, 0.0), (0.01, 0.09, 0.002), (0.0, 0.002, 0.01)])
    poses = rng.multivariate_normal(np.zeros(3), covariance, size=n)
    t = np.arange(n) * 0.1
    figures = accuracy(Trajectory(t, poses, np.tile(covariance, (n, 1, 1))), Trajectory(t, np.zeros((n, 3))))
    low, high = chi2.ppf((5e-7, 1.0 - 5e-7), 3 * n) / n
    assert low < figures["anees"] < high
    low, high = binom.ppf((5e-7, 1.0 - 5e-7), n, 0.95) / n
    assert low <= figures["coverage_95"] <= high


def path(poses):
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1] = c, -s, s, c
    matrices[:, :2, 3] = poses[:, :2]
    return PosePath3D(poses_se3=list(matrices))


def test_absolute_and_relative_errors_are_those_of_evo():
    t, truth, estimate = drive()
    figures = accuracy(Trajectory(t, estimate), Trajectory(t, truth))
    pair = (path(truth), path(estimate))
    ape = evo.APE(evo.PoseRelation.translation_part)
    ape.process_data(pair)
    assert figures["position_rmse"] == pytest.approx(ape.get_statistic(evo.StatisticsType.rmse), rel=1e-9)
    assert figures["position_median"] == pytest.approx(ape.get_statistic(evo.StatisticsType.median), rel=1e-9)
    assert figures["position_max"] == pytest.approx(ape.get_statistic(evo.StatisticsType.max), rel=1e-9)
    turn = evo.APE(evo.PoseRelation.rotation_angle_rad)
    turn.process_data(pair)
    assert figures["heading_rmse"] == pytest.approx(turn.get_statistic(evo.StatisticsType.rmse), rel=1e-6)
    relations = {"position": evo.PoseRelation.translation_part, "heading": evo.PoseRelation.rotation_angle_rad}
    for what, relation in relations.items():
        rpe = evo.RPE(relation, delta=1.0, delta_unit=evo.Unit.meters, all_pairs=False, pairs_from_reference=True)
        rpe.process_data(pair)
        assert figures["rpe_pieces"] == len(rpe.error) > 15
        expected = rpe.get_statistic(evo.StatisticsType.rmse)
        assert figures[f"rpe_{what}_per_m"] == pytest.approx(expected, rel=1e-6)


def log_of(t, truth):
    return Log("log", Rig(), World(), {}, None if truth is None else Trajectory(t, truth))


def test_scored_from_the_first_localized():
    t = np.arange(14) * 0.1
    poses = np.zeros((14, 3))
    poses[:2, 0] = 50.0
    status = ("unlocalized", "ambiguous", "localized", "ambiguous", *("localized",) * 10)
    scores = score(result_of(t, poses, status), log_of(t, np.zeros((14, 3))))
    assert scores["causal.position_max"] == 0.0
    assert scores["final.scored"] == scores["causal.scored"] == 12
    assert scores["time_to_localized"] == pytest.approx(0.2)


def test_never_localized_has_a_final_score_only():
    t = np.arange(5) * 0.1
    scores = score(result_of(t, np.zeros((5, 3)), ("unlocalized",) * 5), log_of(t, np.zeros((5, 3))))
    assert scores["causal.position_rmse"] is None
    assert scores["time_to_localized"] is None
    assert scores["final.scored"] == 5


def test_without_a_reference_nis_counts_and_times_are_reported():
    diagnostics = Diagnostics()
    for nis in (1.0, 2.0, 30.0):
        diagnostics.innovation("bearing_range", 0.0, nis, 2)
    diagnostics.ignore("unknown landmark", 3)
    diagnostics.reject("gate")
    t = np.arange(5) * 0.1
    scores = score(result_of(t, np.zeros((5, 3)), ("localized",) * 5, diagnostics=diagnostics), log_of(t, None))
    assert scores["causal.position_rmse"] is None
    assert scores["nis.bearing_range.median_ratio"] == pytest.approx(2.0 / (2.0 * np.log(2.0)))
    assert scores["nis.bearing_range.beyond_95"] == pytest.approx(1.0 / 3.0)
    assert scores["nis.bearing_range.count"] == 3
    assert scores["ignored.unknown landmark"] == scores["ignored.total"] == 3
    assert scores["rejected.total"] == 1
    assert scores["late.total"] == 0
    assert scores["timing.update_ms_median"] == 2.0
    assert scores["timing.real_time_factor"] == 10.0


def test_learnt_constants_are_scores():
    t = np.arange(5) * 0.1
    learnt = Learnt({"scale_distance": (1.02, 0.01), "bearing_range.x": (0.2, 0.003)})
    scores = score(result_of(t, np.zeros((5, 3)), ("localized",) * 5, learnt=learnt), log_of(t, None))
    assert (scores["learnt.scale_distance.value"], scores["learnt.scale_distance.sigma"]) == (1.02, 0.01)
    assert (scores["learnt.bearing_range.x.value"], scores["learnt.bearing_range.x.sigma"]) == (0.2, 0.003)


@pytest.mark.parametrize("landmarks", ["known", "unknown"])
def test_aligned_figures_only_where_the_map_was_free(landmarks):
    t, truth, _ = drive()
    frame = np.array((5.0, -2.0, 1.0))
    result = result_of(
        t, se2.compose(frame, truth), ("localized",) * len(t), config={"settings": {"landmarks": landmarks}}
    )
    scores = score(result, log_of(t, truth))
    assert scores["final.position_rmse"] > 1.0
    if landmarks == "unknown":
        assert scores["final.aligned_position_rmse"] == pytest.approx(0.0, abs=1e-9)
        assert scores["final.aligned_rotation_rmse"] == pytest.approx(0.0, abs=1e-7)
        assert scores["landmarks.count"] == 0
    else:
        assert all(scores[name] is None for name in OF_FREE_MAP)
        assert "final.aligned_position_rmse" not in scores


def test_innovations_without_degrees_of_freedom_say_nothing():
    diagnostics = Diagnostics()
    for nis, dof in ((0.0, 0), (np.nan, 0), (np.inf, 2), (3.0, 2)):
        diagnostics.innovation("rfid", 0.0, nis, dof)
    diagnostics.innovation("phase", 0.0, 0.0, 0)
    diagnostics.residuals = {"bearing_range.range": [np.nan, 3.0], "bearing_range.bearing": [np.nan]}
    t = np.arange(5) * 0.1
    scores = score(result_of(t, np.zeros((5, 3)), ("localized",) * 5, diagnostics=diagnostics), log_of(t, None))
    assert scores["nis.rfid.median_ratio"] == pytest.approx(1.5 / np.log(2.0))
    assert (scores["nis.rfid.beyond_95"], scores["nis.rfid.count"]) == (0.0, 4)
    assert (scores["nis.phase.median_ratio"], scores["nis.phase.beyond_95"]) == (None, None)
    assert (scores["residual.bearing_range.range.rms"], scores["residual.bearing_range.range.median_abs"]) == (3.0, 3.0)
    assert (scores["residual.bearing_range.bearing.rms"], scores["residual.bearing_range.bearing.median_abs"]) == (
        None,
        None,
    )


def test_a_covariance_that_is_hardly_positive_is_scored():
    poses = np.zeros((3, 3))
    covariances = np.tile(np.diag((1e-300, 1.0, 1.0)), (3, 1, 1))
    e = errors(Trajectory(np.arange(3.0), poses, covariances), Trajectory(np.arange(3.0), poses))
    assert np.all(np.isfinite(e.nees))


FRAME = np.array((4.0, -3.0, 2.5))  # of the world in the estimate's frame
SIGMA = np.array(((0.04, 0.015), (0.015, 0.01)))


def arc():
    t = np.arange(50) * 0.1
    return Trajectory(t, np.stack((np.cos(t), 2.0 * np.sin(t), se2.wrap(t)), axis=1))


def align(estimate, truth):
    pair = pairs(estimate, truth)
    return se2.align_points(pair.poses[:, :2], pair.truth[:, :2])


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
    pose = se2.align_points(points, targets)
    rotation, translation, _ = umeyama_alignment(points.T, targets.T, with_scale=False)
    np.testing.assert_allclose(pose, (*translation, math.atan2(rotation[1, 0], rotation[0, 0])), atol=1e-12)


def test_pairs_without_a_reference_are_left_out():
    truth = arc()
    seen = Trajectory(truth.t[:30], truth.poses[:30])
    poses = se2.compose(FRAME, truth.poses)
    poses[30:] += 100.0
    np.testing.assert_allclose(align(Trajectory(truth.t, poses), seen), se2.inverse(FRAME), atol=1e-12)
    assert np.isnan(align(Trajectory(truth.t + 100.0, poses), seen)).all()
    np.testing.assert_array_equal(se2.align_points(np.ones((3, 2)), np.zeros((3, 2))), (-1.0, -1.0, 0.0))


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

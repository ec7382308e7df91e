"""What fails in an estimator is one line, and what it says is checked."""

import math
import warnings
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from factorgraph_loc import BearingRange, InputError, PoseEstimate, RunFailedError, Tick, Trajectory, VelocityOdometry
from factorgraph_loc.fusion.guarded import Guard, nearest_positive, sound, sound_belief, sound_trajectory
from factorgraph_loc.model.belief import Belief, Mode, gaussian_belief
from factorgraph_loc.model.diagnostics import Diagnostics

SEEN = BearingRange(3.25, ("a",), np.ones(1), np.zeros(1))


def failing(error):
    """An estimator that cannot take a measurement."""

    def process(_):
        raise error

    return SimpleNamespace(process=process)


def estimate(covariance=None, pose=(1.0, 2.0, 0.3), status="localized"):
    return PoseEstimate(1.0, np.array(pose), np.eye(3) if covariance is None else np.array(covariance), status)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (np.linalg.LinAlgError("Singular matrix"), "Singular matrix"),
        (RuntimeError("\n  Indeterminant linear system\nnear 8, and much more"), "Indeterminant linear system"),
        (RuntimeError(), "RuntimeError"),
        (ValueError("x" * 500), "x" * 71 + "..." + "x" * 46),
    ],
)
@pytest.mark.parametrize("quiet", [True, False])
def test_a_failure_is_one_line_with_estimator_time_and_measurement(error, reason, quiet):
    guard = Guard("ekf on hall")
    with pytest.raises(RunFailedError) as told, guard.quiet() if quiet else nullcontext():
        guard.process(failing(error), SEEN)
    assert str(told.value) == f"ekf on hall: bearing_range at 3.250 s: {reason}"
    assert told.value.__cause__ is error
    with pytest.raises(RunFailedError) as told, guard.computing("the estimate at 4.000 s"):
        raise error
    assert str(told.value) == f"ekf on hall: the estimate at 4.000 s (after bearing_range at 3.250 s): {reason}"


@pytest.mark.parametrize("quiet", [True, False])
def test_faults_of_the_program_and_of_the_input_pass(quiet):
    guard = Guard("ekf")
    for error in (KeyError("a"), TypeError("b"), AttributeError("c"), InputError("d"), KeyboardInterrupt()):
        with pytest.raises(type(error)), guard.quiet() if quiet else nullcontext():
            guard.process(failing(error), VelocityOdometry(1.0, 0.0, 0.0))


def test_warnings_are_silent_inside_and_as_before_outside():
    before, guard = np.geterr(), Guard("ekf")

    def overflow(_=None):
        assert not np.isfinite(np.array(1e300) * np.array(1e300))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        guard.process(SimpleNamespace(process=overflow), Tick(1.0))
        with guard.quiet():
            guard.process(SimpleNamespace(process=overflow), Tick(1.0))
            with guard.computing("the estimate"):
                overflow()
            overflow()
        with guard.computing("the estimate"):
            overflow()
    assert np.geterr() == before


def test_a_sound_estimate_is_the_same():
    turned = np.array(((0.6, -0.8, 0.1), (0.8, 0.6, 0.0), (0.0, 0.0, 1.0)))
    for scale in (1e-12, 1.0, 1e12):
        given = estimate(scale * turned @ np.diag((1.0, 1e-3, 10.0)) @ turned.T)
        assert sound(given) is given
    unsaid = estimate(np.full((3, 3), np.nan), (math.nan,) * 3, "unlocalized")
    assert sound(unsaid) is unsaid


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (estimate(pose=(math.nan, 0.0, 0.0)), "the pose is not finite"),
        (estimate(np.diag((1.0, math.nan, 1.0))), "the covariance is not finite"),
        (estimate(np.diag((1.0, 0.0, 1.0))), "the covariance is not positive definite"),
        (estimate(np.diag((1.0, -1.0, 1.0))), "the covariance is not positive definite"),
        (estimate(((1.0, 0.1, 0.0), (0.2, 1.0, 0.0), (0.0, 0.0, 1.0))), "the covariance is not positive definite"),
        (estimate(((1.0, 0.1, 0.0), (0.1, 1.0, 0.0), (math.nan, 0.0, 1.0))), "the covariance is not finite"),
        (estimate(np.eye(2)), "the estimate is not a pose (3,) with a covariance (3, 3)"),
    ],
)
def test_what_cannot_be_is_a_failure(given, why):
    guard = Guard("ekf on hall")
    with pytest.raises(RunFailedError) as told, guard.computing("the estimate", 1.0):
        sound(given)
    assert str(told.value) == f"ekf on hall: the estimate at 1.000 s: {why}"


def test_what_rounding_took_from_a_covariance_is_given_back():
    line = np.array((1e3, 1e-2, 1.0))
    singular = np.outer(line, line)
    found = sound(estimate(singular)).covariance
    assert np.all(np.linalg.eigvalsh(found) > 0.0)
    assert found == pytest.approx(singular, rel=1e-6)
    assert np.array_equal(found, found.T)
    lopsided = np.eye(3)
    lopsided[0, 1] = 1e-12
    assert nearest_positive(lopsided) is lopsided


def test_a_trajectory_names_the_time_of_the_pose_that_cannot_be():
    guard = Guard("batch on hall")
    t, poses, covariances = np.arange(3.0), np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1))
    sound = Trajectory(t, poses, covariances)
    assert sound_trajectory(sound) is sound
    for bad in (np.full((3, 3), np.nan), np.diag((1.0, -1.0, 1.0)), np.zeros((3, 3))):
        wrong = covariances.copy()
        wrong[1] = bad
        with pytest.raises(RunFailedError, match=r"final: the covariance at 1\.000 s is not"), guard.computing("final"):
            sound_trajectory(Trajectory(t, poses, wrong))
    poses = poses.copy()
    poses[2, 1] = np.inf
    with pytest.raises(RunFailedError, match=r"the pose at 2\.000 s is not finite"), guard.computing("final"):
        sound_trajectory(Trajectory(t, poses))
    assert len(sound_trajectory(Trajectory(np.empty(0), np.empty((0, 3)), np.empty((0, 3, 3))))) == 0


def test_a_belief_is_held_to_what_an_estimate_is():
    good = Mode(0.5, np.zeros(3), np.eye(3))
    belief = Belief((good, good), np.zeros((2, 3)), np.full(2, 0.5))
    told = sound_belief(belief)
    assert np.array_equal(told.modes[1].covariance, np.eye(3))
    assert told.particles is belief.particles
    for bad in (replace(good, covariance=np.full((3, 3), np.nan)), replace(good, pose=np.array((0.0, np.inf, 0.0)))):
        with pytest.raises(ValueError, match="is not finite"):
            sound_belief(replace(belief, modes=(good, bad)))
    with pytest.raises(ValueError, match="the particles are not finite"):
        sound_belief(replace(belief, particles=np.full((2, 3), np.nan)))


def test_what_is_taken_back_leaves_no_trace():
    diagnostics = Diagnostics()
    diagnostics.innovation("camera", 1.0, 2.0, 2)
    diagnostics.ignore("stranger", 2)
    before = repr(diagnostics)
    added = diagnostics.record()
    diagnostics.innovation("camera", 2.0, 2.0, 2)
    diagnostics.innovation("rfid", 2.0, 1.0, 1)
    diagnostics.add_residuals("camera.u", (1.0, 2.0))
    diagnostics.ignore("stranger")
    diagnostics.reject("astray", 3)
    diagnostics.take_back(added)
    assert repr(diagnostics) == before


def test_counts_that_did_not_rise_are_not_taken_back():
    """Images without a feature are ignored as 0 features."""
    diagnostics, written = Diagnostics(), []
    for _ in range(2):
        added = diagnostics.record()
        diagnostics.ignore("camera", 0)
        written.append(added)
    for one in reversed(written):
        diagnostics.take_back(one)
    assert not any(diagnostics.ignored.values())


def test_nothing_is_believed_where_the_estimate_is_not_a_number():
    nowhere = PoseEstimate(0.0, np.full(3, np.nan), np.full((3, 3), np.nan), "unlocalized")
    assert gaussian_belief(nowhere).modes == ()


def test_rows_that_were_dropped_meanwhile_cannot_be_taken_back():
    """A robot that runs for long keeps the last rows alone, fewer than it may go back by."""
    diagnostics, written = Diagnostics(), []
    for t in range(3):
        added = diagnostics.record()
        for _ in range(4):
            diagnostics.innovation("camera", float(t), 2.0, 2)
        written.append(added)
    del diagnostics.nis["camera"][:-5]
    for one in reversed(written):
        diagnostics.take_back(one)
    assert diagnostics.nis == {}


def test_rows_are_taken_back_whatever_came_after_them():
    """A late look is taken after newer ones; going back to between them leaves its row, and takes theirs."""
    diagnostics, written = Diagnostics(), {}
    for t in (5.0, 6.0, 4.9):
        added = diagnostics.record()
        diagnostics.innovation("camera", t, 2.0, 2)
        diagnostics.add_residuals("camera.u", (10.0 * t,))
        written[t] = added
    for t in (6.0, 5.0):
        diagnostics.take_back(written[t])
    assert diagnostics.nis == {"camera": [(4.9, 2.0, 2)]}
    assert diagnostics.residuals == {"camera.u": [49.0]}

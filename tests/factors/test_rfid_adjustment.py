"""Models, mounting and clock of a reader as variables: derivatives, tables, and what the parameters mean."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numerical import by_each

from factors import se2
from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts
from factors.rfid.factor import RfidFactor
from factors.rfid.model import Antenna, BeamModel, LogisticModel, RfidModel, bake, probability

POSE = np.array((0.3, -0.2, 0.5))
MODELS = (
    BeamModel(),
    bake(BeamModel(0.8, 3.0, 0.4, 0.8), 5.0, 0.1),
    LogisticModel((3.0, -1.2, -0.1, -1.0, -0.2, 0.1, -0.3, 0.5, 0.2, -0.1, 0.1)),
)
ANTENNAS = (Antenna(0.1, 0.2, 1.0, 0.3, 0.1, 0), Antenna(z=1.1, yaw=2.0, model=1), Antenna(y=0.1, yaw=-2.0, model=2))
MODEL = RfidModel(ANTENNAS, MODELS, 1e-3, 0.0, 0.7)
PARAMETERS, YAW = 11, 6  # number of parameters, and the place of the yaw of all antennas


def scene(seed: int, half: float = 4.0) -> tuple[RfidLikelihood, TagReadCounts, np.ndarray]:
    """Twelve tags in a square, some of which may be dead, looked at by three antennas of a robot that drives; and parameters."""
    rng = np.random.default_rng(seed)
    places = np.column_stack((rng.uniform(-half, half, (12, 2)), rng.uniform(0.8, 1.4, 12)))
    odds = np.where(rng.random(12) < 0.5, -np.inf, -2.0)
    counts = rng.normal(0.0, 0.1, (3, 3)), np.arange(3), np.array((3, 2, 4)), rng.integers(0, 2, (3, 12))
    looks = TagReadCounts(*counts, odds, twists=np.array(((0.5, 0.0, 0.4), (0.5, 0.1, 0.4), (0.6, 0.1, -0.2))))
    likelihood = RfidLikelihood(MODEL, TagArray(places, rng.uniform(-3.0, 3.0, 12)))
    return likelihood, looks, rng.normal(0.0, 0.2, PARAMETERS)


@given(st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_the_gradient_is_that_of_the_likelihood(seed):
    likelihood, looks, parameters = scene(seed, 2.5)
    values = [POSE, parameters]
    numeric = np.concatenate(by_each(lambda v: likelihood.joint_score(*v, looks).nll[0], values, step=1e-5))
    found = likelihood.joint_score(POSE, parameters, looks)
    # a tag may lie at an edge of the grid's knots, or of the reach
    assert np.median(np.abs(found.gradient[0] - numeric)) < 1e-5
    np.testing.assert_allclose(found.gradient[0], numeric, atol=0.05)
    assert np.linalg.eigvalsh(found.information[0])[0] > -1e-9


@pytest.mark.parametrize("seed", range(5))
def test_it_is_the_likelihood_of_the_adjusted_models(seed):
    likelihood, looks, parameters = scene(seed)
    joint, plain = likelihood.joint_score(POSE, parameters, looks), likelihood.adjusted(parameters).score(POSE, looks)
    for name in ("nll", "expected", "variance"):
        np.testing.assert_allclose(getattr(joint, name), getattr(plain, name), rtol=1e-12)
    np.testing.assert_allclose(joint.gradient[0, :3], plain.gradient[0], atol=1e-10)
    np.testing.assert_allclose(joint.information[0, :3, :3], plain.information[0], atol=1e-10)
    unchanged = likelihood.joint_score(POSE, np.zeros(PARAMETERS), looks)
    np.testing.assert_allclose(unchanged.nll, likelihood.score(POSE, looks).nll, rtol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_tables_tell_the_same_of_particles_with_models_of_their_own(seed):
    likelihood, looks, _ = scene(seed)
    rng = np.random.default_rng(100 + seed)
    poses = se2.compose(POSE, rng.normal(0.0, 0.2, (20, 3)))
    parameters = rng.normal(0.0, 0.2, (20, PARAMETERS))
    parameters[:, YAW:-1] *= 0.5
    looks = replace(looks, offsets=np.zeros((3, 3)), twists=looks.twists[[0, 0, 0]])
    exact = [-likelihood.joint_score(p, q, looks).nll[0] for p, q in zip(poses, parameters, strict=True)]
    found = likelihood.log_likelihood(poses, looks, parameters)
    # cells of 5 cm, which tell most next to an antenna, and steps of a twentieth of a logit
    assert np.median(np.abs(found - exact)) < 0.1
    assert np.abs(found - exact).max() < 2.0
    own = likelihood.adjusted(parameters[0])
    np.testing.assert_allclose(
        own.log_likelihood(poses, looks), likelihood.log_likelihood(poses, looks, np.tile(parameters[0], (20, 1)))
    )


def test_of_a_beam_they_are_another_range_and_another_probability():
    likelihood = RfidLikelihood(
        RfidModel((Antenna(),), (BeamModel(0.9, 4.0, 0.3, 0.7),), 0.0),
        TagArray(np.array(((3.9, 0.8, 0.0),)), np.zeros(1)),
    )
    logit = np.log(0.6 / 0.4) - np.log(0.9 / 0.1)
    found = likelihood.adjusted(np.array((np.log(1.25), logit, 0.0, 0.0, 0.0))).probabilities(np.zeros((1, 3)), 0)
    expected = probability(BeamModel(0.6, 5.0, 0.375, 0.7), np.array(((3.9, 0.8, 0.0),)))
    np.testing.assert_allclose(found[0], expected, rtol=1e-4)  # distances near the antenna are rounded off


def test_a_turned_antenna_and_a_late_clock_are_those_of_another_rig():
    likelihood, looks, _ = scene(6)
    found = likelihood.adjusted(np.array((*np.zeros(YAW), 0.2, 0.1, 0.0, -0.3, 0.5)))
    turns = 0.3, 0.2, -0.1
    antennas = tuple(replace(a, yaw=a.yaw + turn) for a, turn in zip(ANTENNAS, turns, strict=True))
    later = replace(looks, offsets=se2.compose(looks.offsets, se2.exp(0.5 * looks.twists)))
    other = RfidLikelihood(replace(MODEL, antennas=antennas), likelihood.tags)
    assert found.score(POSE, looks).nll == pytest.approx(other.score(POSE, later).nll, rel=1e-9)


def test_a_factor_with_variables_has_the_likelihood_as_its_cost():
    likelihood, looks, parameters = scene(3)
    factor = RfidFactor(likelihood, looks, (0, 3))
    values = [POSE, parameters[[0, 3]]]
    residual, jacobians = factor.linearize(values)
    assert residual.shape == (factor.rows,) == (6,)
    assert [j.shape for j in jacobians] == [(6, 3), (6, 2)]
    assert 0.5 * residual @ residual == pytest.approx(factor.cost(values))
    score = factor.score(values)
    np.testing.assert_allclose(np.hstack(jacobians).T @ residual, score.gradient[0], rtol=1e-6, atol=1e-6)


def test_an_update_of_pose_and_parameters_is_that_of_the_pose_where_these_are_exact():
    likelihood, looks, _ = scene(4)
    covariance = np.diag((0.01, 0.02, 0.01))
    alone = RfidFactor(likelihood, looks).correct(POSE, covariance)
    joint = np.diag((0.01, 0.02, 0.01, 1e-14))
    found = RfidFactor(likelihood, looks, (0,)).correct(POSE, joint, np.zeros(1))
    np.testing.assert_allclose(found.delta[:3], alone.delta, atol=1e-6)
    np.testing.assert_allclose(found.covariance[:3, :3], alone.covariance, atol=1e-7)
    wide = RfidFactor(likelihood, looks, (0,)).correct(POSE, np.diag((0.01, 0.02, 0.01, 0.04)), np.zeros(1))
    assert wide.covariance[3, 3] < 0.04
    assert np.linalg.slogdet(wide.covariance[:3, :3])[1] > np.linalg.slogdet(alone.covariance)[1] - 0.5

"""Antennas fixed in the world and tags on the robot: the same likelihood with exchanged frames."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numerical import by_pose

from factors import se2
from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts, merged
from factors.rfid.factor import RfidFactor
from factors.rfid.model import Antenna, BeamModel, DetectionModel, LogisticModel, RfidModel, bake
from factors.se2 import Array

LOGISTIC = LogisticModel((3.0, -1.2, 0.02, -1.5, 0.2, -0.06, -0.6, 0.4, 0.9, 0.1, -0.16))
MODELS: dict[str, DetectionModel] = {
    "beam": BeamModel(behind=0.5),
    "logistic": LOGISTIC,
    "grid": bake(LOGISTIC, 6.0, 0.2, heights=(-0.4, 0.0, 0.4), facings=7),
}
POSE = np.array((34.0, 13.0, 0.5))


def likelihood_of(model: DetectionModel, antenna: Array, tag: Array, *, fixed: bool) -> RfidLikelihood:
    """One antenna and one tag at poses (3,): in the robot frame and the world, or the reverse if ``fixed``."""
    mounted = Antenna(antenna[0], antenna[1], 1.0, antenna[2], 0.1)
    tags = TagArray(np.array([(tag[0], tag[1], 1.3)]), tag[2:])
    return RfidLikelihood(RfidModel((mounted,), (model,), 0.01, 0.02, fixed=fixed), tags)


@pytest.mark.parametrize("name", MODELS)
@given(seed=st.integers(0, 1000))
def test_a_fixed_antenna_and_a_tag_on_the_robot_are_as_likely_as_the_reverse(name: str, seed: int) -> None:
    """A robot with an antenna at one pose, and another robot with the tag: antenna and tag have the same poses in the world."""
    rng = np.random.default_rng(seed)
    pose, other, mounting = (rng.normal(size=3) * (1.0, 1.0, 2.0) for _ in range(3))
    antenna, tag = se2.compose(pose, mounting), rng.normal(size=3) * (2.0, 2.0, 2.0)
    on_robot = likelihood_of(MODELS[name], mounting, tag, fixed=False)
    in_building = likelihood_of(MODELS[name], antenna, se2.compose(se2.inverse(other), tag), fixed=True)
    one = np.zeros((1, 3)), np.zeros(1, dtype=np.int64), np.array([5])
    for hits in range(6):
        counts = TagReadCounts(*one, np.array([[hits]]))
        expected, score = on_robot.score(pose, counts), in_building.score(other, counts)
        for field in ("nll", "expected", "variance"):
            assert getattr(score, field) == pytest.approx(getattr(expected, field), rel=1e-9)
        weights = [of.log_likelihood(at[None], counts)[0] for of, at in ((on_robot, pose), (in_building, other))]
        assert weights[1] == pytest.approx(weights[0], rel=1e-3, abs=0.3)  # from tables, with cells of 5 cm


def scene(model: DetectionModel, seed: int) -> tuple[RfidLikelihood, TagReadCounts]:
    """Six antennas around the robot, three tags on the robot, and four measurements at different poses of the robot in motion."""
    rng = np.random.default_rng(seed)
    antennas = tuple(
        Antenna(POSE[0] + 2.5 * math.cos(a), POSE[1] + 2.5 * math.sin(a), 1.5, rng.uniform(-3.0, 3.0), -0.2)
        for a in np.arange(6) * math.pi / 3.0
    )
    facing = np.array((0.3, -2.0, np.nan))
    tags = TagArray(np.column_stack((rng.normal(size=(3, 2)) * 0.3, (1.2, 1.2, 0.9))), facing)
    hits, odds = rng.integers(0, 3, (4, 3)), np.array((-np.inf, -2.0, -3.0))
    used = rng.integers(0, 6, 4)
    counts = TagReadCounts(rng.normal(size=(4, 3)) * 0.2, used, np.full(4, 2), hits, odds, np.zeros(3))
    counts = replace(counts, elsewhere=np.full(3, -1.5), twists=np.tile((0.5, 0.1, -0.4), (4, 1)))
    return RfidLikelihood(RfidModel(antennas, (model,), 0.01, 0.02, 0.7, fixed=True), tags), counts


@pytest.mark.parametrize("name", MODELS)
@given(seed=st.integers(0, 1000))
def test_derivatives_by_pose_and_parameters(name: str, seed: int) -> None:
    """The parameters are those of the model, the yaws of the antennas and the time offset."""
    likelihood, counts = scene(MODELS[name], seed)
    parameters = np.random.default_rng(seed).normal(size=len(likelihood.parameters)) * 0.05

    def cost(pose: Array, change: Array) -> float:
        return float(likelihood.adjusted(parameters + change).score(pose, counts).nll[0])

    gradient = likelihood.joint_score(POSE, parameters, counts).gradient[0]
    steps = 1e-6 * np.eye(len(parameters))
    numeric = [(cost(POSE, step) - cost(POSE, -step)) / 2e-6 for step in steps]
    by_body = by_pose(lambda pose: cost(pose, np.zeros_like(parameters)), POSE)
    assert gradient[:3] == pytest.approx(by_body, abs=2e-3, rel=2e-3)
    assert gradient[3:] == pytest.approx(np.array(numeric), abs=2e-3, rel=2e-3)


@pytest.mark.parametrize("name", MODELS)
def test_particles_have_the_exact_likelihood_to_the_width_of_a_cell(name: str) -> None:
    """Particles near each other, and poses of a search that are metres apart, each with its own parameters."""
    likelihood, counts = scene(MODELS[name], 3)
    likelihood.prepare()
    rng = np.random.default_rng(1)
    for width in (0.1, 3.0):
        poses = POSE + rng.normal(size=(50, 3)) * (width, width, 0.5)
        parameters = rng.normal(size=(50, len(likelihood.parameters))) * 0.05
        parameters[:, -1] = 0.02
        weights = likelihood.log_likelihood(poses, counts, parameters)
        exact = [-likelihood.adjusted(p).score(x, counts).nll[0] for x, p in zip(poses, parameters, strict=True)]
        assert weights == pytest.approx(np.array(exact), abs=0.3)


def test_measurements_merge_and_a_correction_finds_the_pose() -> None:
    likelihood, counts = scene(MODELS["beam"], 5)
    parts = [
        replace(
            counts,
            **{k: getattr(counts, k)[i : i + 1] for k in ("offsets", "antennas", "rounds", "hits", "twists")},
            elsewhere=counts.elsewhere / 4.0,
        )
        for i in range(4)
    ]
    assert likelihood.score(POSE, merged(parts)).nll == pytest.approx(likelihood.score(POSE, counts).nll)
    # rounds with the expected reads: the robot is where they say
    offsets, used = np.zeros((6, 3)), np.arange(6)
    p = np.array([likelihood.probabilities(POSE[None], a)[0] for a in range(6)])
    reads = TagReadCounts(offsets, used, np.full(6, 1000), np.rint(1000 * p).astype(np.int64))
    start = se2.compose(POSE, np.array((0.2, -0.15, 0.2)))
    correction = RfidFactor(likelihood, reads).correct(start, np.diag((0.3, 0.3, 0.3)) ** 2, iterations=20)
    found = se2.compose(start, se2.exp(correction.delta))
    assert found == pytest.approx(POSE, abs=0.05)


@pytest.mark.parametrize("name", MODELS)
def test_information_is_the_covariance_of_the_gradient_over_all_outcomes(name: str) -> None:
    """One round of one antenna and one tag has two outcomes. The parameters are included."""
    likelihood, counts = scene(MODELS[name], 4)
    zero, total = np.zeros_like(likelihood.parameters), 0.0
    for a, t in np.ndindex(6, 3):
        one = RfidLikelihood(
            replace(likelihood.model, tempering=1.0), TagArray(*(x[t : t + 1] for x in tags_of(likelihood)))
        )
        p = one.probabilities(se2.compose(POSE, counts.offsets[:1]), a)[0, 0]
        expected = 0.0
        for hit, weight in ((0, 1.0 - p), (1, p)):
            read = TagReadCounts(
                counts.offsets[:1], np.array([a]), np.array([1]), np.array([[hit]]), twists=counts.twists[:1]
            )
            score = one.joint_score(POSE, zero, read)
            expected = expected + weight * np.outer(score.gradient[0], score.gradient[0])
        np.testing.assert_allclose(score.information[0], expected, atol=1e-9)
        total += float(np.trace(expected))
    assert total > 1.0


def tags_of(likelihood: RfidLikelihood) -> tuple[Array, Array]:
    return likelihood.tags.points, likelihood.tags.facing

"""Models of detection, of signal strength and of phase."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numerical import by_pose, derivative
from scipy import stats

from factors import se2
from factors.rfid.detection import TagArray
from factors.rfid.model import Antenna, BeamModel, GridModel, LogisticModel, bake, logits, probability
from factors.rfid.signals import (
    SPEED_OF_LIGHT,
    PhaseLikelihood,
    PhaseModel,
    PhaseReads,
    RssiLikelihood,
    RssiModel,
    RssiReads,
    features,
)
from factors.se2 import Array

COEFFICIENTS = (3.9, -1.5, 0.06, -1.7, 0.25, -0.06, -0.6, -0.1, 1.9, 0.23, -0.16)


def wavy(facings: int = 5) -> GridModel:
    rng = np.random.default_rng(3)
    return GridModel(rng.normal(size=(3, facings, 12, 14)), -1.5, -2.0, 0.25, np.array((-0.5, 0.0, 0.5)))


MODELS = {
    "beam": BeamModel(),
    "logistic": LogisticModel(COEFFICIENTS),
    "grid": wavy(),
    "flat grid": bake(BeamModel(), 6.0, 0.2),
}


@pytest.mark.parametrize("name", MODELS)
@given(
    x=st.floats(-1.2, 1.2).filter(lambda v: abs(v) > 0.05),
    y=st.floats(-1.4, 1.0).filter(lambda v: abs(v) > 0.05),
    z=st.floats(-0.45, 0.45).filter(lambda v: abs(v) > 0.01),
    c=st.floats(-0.95, 0.95),
)
def test_gradient_is_that_of_the_logit(name: str, x: float, y: float, z: float, c: float) -> None:
    at = np.array((x, y, z, c))
    numeric = derivative(lambda d: logits(MODELS[name], at[:3] + d[:3], at[3] + d[3])[0][0], 4)
    found = logits(MODELS[name], at[:3], at[3])[1][0]
    # across a knot the second derivative of a grid jumps
    assert found == pytest.approx(numeric, abs=2e-4 * (1.0 + np.abs(numeric).max()))


def test_beam_is_the_formula() -> None:
    r, phi = 3.0, 0.5
    point = np.array((r * math.cos(phi), r * math.sin(phi), 0.0))
    expected = 0.9 / (1.0 + math.exp(-(4.5 - r) / 0.3)) * math.exp(-0.5 * (phi / 0.698) ** 2)
    assert probability(BeamModel(), point)[0] == pytest.approx(expected, rel=1e-5)


def test_a_certain_beam_has_finite_logits() -> None:
    value, gradient = logits(BeamModel(p0=1.0 - 1e-15), np.array(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))))
    assert np.all(np.isfinite(value))
    assert np.all(np.isfinite(gradient))


def test_logistic_is_linear_in_its_features() -> None:
    x, y, z, c = 1.2, -0.8, -0.4, 0.6
    r, w = math.hypot(x, y), 1.0 - x / math.hypot(x, y)
    features = (1.0, r, r * r, w, w * w, r * w, abs(z), c, c * c, r * c, w * c)
    assert logits(MODELS["logistic"], np.array((x, y, z)), c)[0][0] == pytest.approx(
        np.dot(COEFFICIENTS, features), abs=1e-3
    )


def test_grid_goes_through_its_knots() -> None:
    grid = wavy()
    for h, f, i, j in ((0, 0, 0, 0), (1, 2, 5, 7), (2, 4, 11, 13)):
        point = np.array((grid.x0 + i * grid.cell, grid.y0 + j * grid.cell, grid.heights[h]))
        facing = -1.0 + 2.0 * f / 4.0
        assert logits(grid, point, facing)[0][0] == pytest.approx(grid.logits[h, f, i, j], abs=1e-9)


def test_grid_keeps_a_plane() -> None:
    """Cubic convolution is exact for what is linear (inside: at the edge knots are repeated)."""
    x, y = np.meshgrid(np.arange(8) * 0.5, np.arange(9) * 0.5, indexing="ij")
    grid = GridModel((2.0 * x - 3.0 * y)[None, None], 0.0, 0.0, 0.5, np.zeros(1))
    rng = np.random.default_rng(0)
    points = np.column_stack((rng.uniform(0.5, 3.0, (50, 2)), np.zeros(50)))
    assert logits(grid, points)[0] == pytest.approx(2.0 * points[:, 0] - 3.0 * points[:, 1], abs=1e-9)


def test_beyond_its_knots_a_grid_has_the_value_of_the_edge() -> None:
    grid = wavy(1)
    inside, outside = np.array((-1.5, 0.3, 0.0)), np.array((-9.0, 0.3, 0.0))
    value, gradient = logits(grid, np.array((inside, outside)))
    assert value[1] == pytest.approx(value[0])
    assert gradient[1, 0] == 0.0


def test_baked_model_is_near_the_model() -> None:
    rng = np.random.default_rng(1)
    for model, facings in ((BeamModel(), 1), (LogisticModel(COEFFICIENTS), 9)):
        grid = bake(model, 4.0, 0.1, heights=(-0.6, -0.3, 0.0, 0.3, 0.6), facings=facings)
        # in front of the antenna and not beside it, where the field has a peak
        points = np.column_stack((rng.uniform(0.5, 3.5, 200), rng.uniform(-3.0, 3.0, 200), rng.uniform(-0.6, 0.6, 200)))
        c = rng.uniform(-1.0, 1.0, 200)
        assert np.abs(probability(grid, points, c) - probability(model, points, c)).max() < 0.03


ANTENNAS = (Antenna(-0.2, -0.3, 1.0, -1.5, 0.1), Antenna(0.1, 0.2, 0.5, 0.7))
STRENGTHS = (-50.0, 2.2, -6.0, -1.5, 3.0, 2.0)
POSE = np.array((0.4, -0.2, 0.6))


def tags(rng: np.random.Generator, count: int = 20) -> TagArray:
    points = np.column_stack((rng.uniform(-4.0, 4.0, (count, 2)), rng.uniform(0.2, 1.8, count)))
    facing = np.where(rng.random(count) < 0.3, np.nan, rng.uniform(-3.0, 3.0, count))
    return TagArray(points, facing)


def simulated(rng: np.random.Generator, model: RssiModel, world: TagArray, count: int) -> RssiReads:
    offsets = rng.normal(0.0, (0.3, 0.3, 0.2), (count, 3))
    antennas, which = rng.integers(0, 2, count), rng.integers(0, len(world.points), count)
    reads = RssiReads(offsets, antennas, which, np.zeros(count))
    expected = features(ANTENNAS, world, POSE, reads) @ np.array(model.coefficients)
    return RssiReads(offsets, antennas, which, expected + model.sigma * rng.standard_t(model.dof, count))


@pytest.fixture
def likelihood() -> RssiLikelihood:
    model = RssiModel(ANTENNAS, STRENGTHS, sigma=2.0, dof=4.0, tempering=0.5)
    return RssiLikelihood(model, tags(np.random.default_rng(0)))


def test_value_is_students_density(likelihood: RssiLikelihood) -> None:
    reads = simulated(np.random.default_rng(1), likelihood.model, likelihood.tags, 50)
    residuals = reads.rssi - features(ANTENNAS, likelihood.tags, POSE, reads) @ np.array(STRENGTHS)
    density = stats.t(4.0, scale=2.0)
    expected = 0.5 * np.sum(density.logpdf(0.0) - density.logpdf(residuals))
    assert likelihood.score(POSE, reads).nll[0] == pytest.approx(expected)
    assert likelihood.log_likelihood(POSE[None], reads)[0] == pytest.approx(-expected)


def test_gradient_is_that_of_the_value(likelihood: RssiLikelihood) -> None:
    reads = simulated(np.random.default_rng(2), likelihood.model, likelihood.tags, 50)
    poses = POSE + np.random.default_rng(3).normal(0.0, 0.5, (5, 3))
    numeric = [by_pose(lambda p: likelihood.score(p, reads).nll[0], pose) for pose in poses]
    assert np.allclose(likelihood.score(poses, reads).gradient, numeric, rtol=1e-5, atol=1e-5)


def test_information_is_the_expected_square_of_the_gradient(likelihood: RssiLikelihood) -> None:
    """Of independent reads: the mean over 4,000 draws lies within 10 % (its own spread is 2 %)."""
    rng = np.random.default_rng(4)
    scores = [likelihood.score(POSE, simulated(rng, likelihood.model, likelihood.tags, 1)) for _ in range(4000)]
    # both are tempered, so the square of the gradient is so twice
    squared = np.mean([np.outer(s.gradient[0], s.gradient[0]) for s in scores], axis=0) / 0.5
    information: Array = np.mean([s.information[0] for s in scores], axis=0)
    assert np.abs(squared - information).max() < 0.1 * np.trace(information)
    assert np.linalg.eigvalsh(information).min() > 0.0


def test_a_tag_at_the_antenna_is_no_trouble(likelihood: RssiLikelihood) -> None:
    at = se2.transform_from(POSE, np.array((ANTENNAS[0].x, ANTENNAS[0].y)))
    world = TagArray(np.array([(*at, ANTENNAS[0].z)]), np.array([0.0]))
    reads = RssiReads(np.zeros((1, 3)), np.zeros(1, np.int64), np.zeros(1, np.int64), np.array([-40.0]))
    assert all(np.isfinite(part).all() for part in RssiLikelihood(likelihood.model, world).score(POSE, reads))


PAIR = (Antenna(-0.2, -0.3, 1.0), Antenna(-0.2, -0.3, 0.5))
STAND = np.array((0.4, -0.2, 0.1))
FREQUENCY = 920.625e6


def world(rng: np.random.Generator, count: int = 12) -> TagArray:
    points = np.column_stack(
        (rng.uniform(-1.5, 2.0, count), rng.uniform(-2.0, -1.0, count), rng.uniform(0.2, 1.8, count))
    )
    return TagArray(points, np.full(count, np.nan))


def drawn_phases(
    rng: np.random.Generator, tags: TagArray, count: int = 300, noise: float = 0.2, length: float = 0.6
) -> PhaseReads:
    """Reads on a drive of ``length`` [m] past the tags, with an offset of each antenna and tag and pi added at random."""
    s = np.sort(rng.uniform(-0.5, 0.5, count))
    offsets = np.column_stack((length * s, 0.05 * s, 0.2 * s))
    antennas, which = rng.integers(0, 2, count), rng.integers(0, len(tags.points), count)
    at = se2.compose(STAND, offsets)
    places = np.array([(a.x, a.y, a.z) for a in PAIR])[antennas]
    antenna = np.column_stack((se2.transform_from(at, places[:, :2]), places[:, 2]))
    distance = np.linalg.norm(antenna - tags.points[which], axis=1)
    unknown = rng.uniform(0.0, 2.0 * np.pi, (2, len(tags.points)))[antennas, which]
    phase = unknown - 4.0 * np.pi * FREQUENCY / SPEED_OF_LIGHT * distance + np.pi * (rng.random(count) < 0.2)
    phase = np.mod(phase + rng.normal(0.0, noise, count), 2.0 * np.pi)
    return PhaseReads(offsets, antennas, which, phase, np.full(count, FREQUENCY), np.zeros(count, np.int64))


@pytest.fixture
def phase_likelihood() -> PhaseLikelihood:
    return PhaseLikelihood(PhaseModel(PAIR, kappa=2.0, tempering=0.5, max_range=5.0), world(np.random.default_rng(0)))


def reference_nll(phase_likelihood: PhaseLikelihood, pose: Array, reads: PhaseReads) -> float:
    """By the definition, one read after the other."""
    sums: dict[tuple[int, int], complex] = {}
    for offset, a, t, phase in zip(reads.offsets, reads.antennas, reads.tags, reads.phase, strict=True):
        antenna = PAIR[a]
        x, y = se2.transform_from(se2.compose(pose, offset), np.array((antenna.x, antenna.y)))
        distance = float(np.linalg.norm(np.array((x, y, antenna.z)) - phase_likelihood.tags.points[t]))
        psi = 2.0 * phase + 8.0 * np.pi * FREQUENCY / SPEED_OF_LIGHT * distance
        sums[a, t] = sums.get((a, t), 0j) + complex(np.cos(psi), np.sin(psi))
    return 2.0 * 0.5 * (len(reads.tags) - sum(abs(s) for s in sums.values()))


def test_value_is_that_of_the_definition(phase_likelihood: PhaseLikelihood) -> None:
    reads = drawn_phases(np.random.default_rng(1), phase_likelihood.tags)
    poses = STAND + np.random.default_rng(2).normal(0.0, 0.05, (4, 3))
    expected = [reference_nll(phase_likelihood, pose, reads) for pose in poses]
    assert phase_likelihood.score(poses, reads).nll == pytest.approx(expected)
    assert phase_likelihood.log_likelihood(poses, reads) == pytest.approx(-np.array(expected))


@given(seed=st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_gradient_is_that_of_the_value_and_information_is_never_indefinite(seed: int) -> None:
    rng = np.random.default_rng(seed)
    phase_likelihood = PhaseLikelihood(PhaseModel(PAIR), world(rng))
    reads = drawn_phases(rng, phase_likelihood.tags, 60, noise=rng.uniform(0.0, 2.0))
    pose = se2.compose(STAND, se2.exp(rng.normal(0.0, 0.1, 3)))
    score = phase_likelihood.score(pose, reads)
    numeric = by_pose(lambda p: phase_likelihood.score(p, reads).nll[0], pose)
    assert np.allclose(score.gradient[0], numeric, rtol=1e-4, atol=1e-4)
    assert np.allclose(score.information[0], score.information[0].T)
    assert np.linalg.eigvalsh(score.information[0]).min() > -1e-9 * np.trace(score.information[0])


def test_information_is_the_hessian_at_clean_phases(phase_likelihood: PhaseLikelihood) -> None:
    reads = drawn_phases(np.random.default_rng(3), phase_likelihood.tags, noise=0.0)
    score = phase_likelihood.score(STAND, reads)
    hessian = by_pose(lambda p: phase_likelihood.score(p, reads).gradient[0], STAND, 1e-5)
    assert np.allclose(score.information[0], hessian, atol=1e-3 * np.trace(hessian))
    assert np.allclose(score.gradient, 0.0, atol=1e-6)


def test_offsets_and_flips_do_not_matter(phase_likelihood: PhaseLikelihood) -> None:
    rng = np.random.default_rng(4)
    reads = drawn_phases(rng, phase_likelihood.tags)
    offsets = rng.uniform(0.0, 6.0, (2, len(phase_likelihood.tags.points)))[reads.antennas, reads.tags]
    other = replace(reads, phase=reads.phase + offsets + np.pi * rng.integers(0, 2, len(offsets)))
    ours, theirs = phase_likelihood.score(STAND, reads), phase_likelihood.score(STAND, other)
    assert theirs.nll == pytest.approx(ours.nll)
    assert theirs.gradient[0] == pytest.approx(ours.gradient[0])


def test_groups_are_of_one_tag_antenna_channel_and_window(phase_likelihood: PhaseLikelihood) -> None:
    reads = drawn_phases(np.random.default_rng(5), phase_likelihood.tags, 4)
    same = replace(reads, antennas=np.zeros(4, np.int64), tags=np.zeros(4, np.int64))
    assert len(set(same.groups.tolist())) == 1
    rounded = replace(same, frequency=FREQUENCY + np.array((0.0, 1.0, 2.0, 3.0)))  # Hz, within one channel
    assert len(set(rounded.groups.tolist())) == 1
    steps = np.array((0, 0, 1, 1))
    columns: tuple[tuple[str, Any], ...] = (
        ("antennas", steps),
        ("tags", steps),
        ("windows", steps),
        ("frequency", FREQUENCY + 250e3 * steps),
    )
    for name, values in columns:
        assert replace(same, **{name: values}).groups.tolist() == [0, 0, 1, 1]


def test_far_reads_and_small_groups_are_left_out(phase_likelihood: PhaseLikelihood) -> None:
    points = np.array([(0.5, -1.5, 0.8), (0.5, -9.0, 0.8), (0.2, -1.5, 0.8)])
    model = replace(phase_likelihood.model, max_range=2.5, min_reads=3)
    three = PhaseLikelihood(model, TagArray(points, np.full(3, np.nan)))
    tags = np.array((0, 0, 0, 1, 1, 1, 2, 2))
    reads = PhaseReads(
        np.zeros((8, 3)), np.zeros(8, np.int64), tags, np.zeros(8), np.full(8, FREQUENCY), np.zeros(8, np.int64)
    )
    assert three.near(STAND, reads).tags.tolist() == [0, 0, 0]
    none = three.near(np.array((50.0, 0.0, 0.0)), reads)
    assert len(none.tags) == 0
    assert not any(part.any() for part in three.score(STAND, none))
    assert not three.log_likelihood(STAND[None], none).any()


def test_reads_can_be_placed_around_another_pose(phase_likelihood: PhaseLikelihood) -> None:
    reads = drawn_phases(np.random.default_rng(7), phase_likelihood.tags)
    step = np.array((0.5, -0.1, 0.3))
    before = se2.compose(STAND, se2.inverse(step))
    assert phase_likelihood.score(before, reads.moved(step)).nll == pytest.approx(
        phase_likelihood.score(STAND, reads).nll
    )

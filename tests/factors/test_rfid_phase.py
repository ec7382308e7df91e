"""Phase: the likelihood's derivatives, what it does not depend on, and what it says of a pose."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numerical import by_pose

from factors import se2
from factors.rfid.detection import TagArray
from factors.rfid.model import Antenna
from factors.rfid.signals import SPEED_OF_LIGHT, PhaseLikelihood, PhaseModel, PhaseReads
from factors.se2 import Array

ANTENNAS = (Antenna(-0.2, -0.3, 1.0), Antenna(-0.2, -0.3, 0.5))
POSE = np.array((0.4, -0.2, 0.1))
FREQUENCY = 920.625e6


def world(rng: np.random.Generator, count: int = 12) -> TagArray:
    points = np.column_stack(
        (rng.uniform(-1.5, 2.0, count), rng.uniform(-2.0, -1.0, count), rng.uniform(0.2, 1.8, count))
    )
    return TagArray(points, np.full(count, np.nan))


def simulated(
    rng: np.random.Generator, tags: TagArray, count: int = 300, noise: float = 0.2, length: float = 0.6
) -> PhaseReads:
    """Reads on a drive of ``length`` [m] past the tags, with an offset of each antenna and tag and pi added at random."""
    s = np.sort(rng.uniform(-0.5, 0.5, count))
    offsets = np.column_stack((length * s, 0.05 * s, 0.2 * s))
    antennas, which = rng.integers(0, 2, count), rng.integers(0, len(tags.points), count)
    at = se2.compose(POSE, offsets)
    places = np.array([(a.x, a.y, a.z) for a in ANTENNAS])[antennas]
    antenna = np.column_stack((se2.transform_from(at, places[:, :2]), places[:, 2]))
    distance = np.linalg.norm(antenna - tags.points[which], axis=1)
    unknown = rng.uniform(0.0, 2.0 * np.pi, (2, len(tags.points)))[antennas, which]
    phase = unknown - 4.0 * np.pi * FREQUENCY / SPEED_OF_LIGHT * distance + np.pi * (rng.random(count) < 0.2)
    phase = np.mod(phase + rng.normal(0.0, noise, count), 2.0 * np.pi)
    return PhaseReads(offsets, antennas, which, phase, np.full(count, FREQUENCY), np.zeros(count, np.int64))


@pytest.fixture
def likelihood() -> PhaseLikelihood:
    return PhaseLikelihood(
        PhaseModel(ANTENNAS, kappa=2.0, tempering=0.5, max_range=5.0), world(np.random.default_rng(0))
    )


def reference_nll(likelihood: PhaseLikelihood, pose: Array, reads: PhaseReads) -> float:
    """By the definition, one read after the other."""
    sums: dict[tuple[int, int], complex] = {}
    for offset, a, t, phase in zip(reads.offsets, reads.antennas, reads.tags, reads.phase, strict=True):
        antenna = ANTENNAS[a]
        x, y = se2.transform_from(se2.compose(pose, offset), np.array((antenna.x, antenna.y)))
        distance = float(np.linalg.norm(np.array((x, y, antenna.z)) - likelihood.tags.points[t]))
        psi = 2.0 * phase + 8.0 * np.pi * FREQUENCY / SPEED_OF_LIGHT * distance
        sums[a, t] = sums.get((a, t), 0j) + complex(np.cos(psi), np.sin(psi))
    return 2.0 * 0.5 * (len(reads.tags) - sum(abs(s) for s in sums.values()))


def test_value_is_that_of_the_definition(likelihood: PhaseLikelihood) -> None:
    reads = simulated(np.random.default_rng(1), likelihood.tags)
    poses = POSE + np.random.default_rng(2).normal(0.0, 0.05, (4, 3))
    expected = [reference_nll(likelihood, pose, reads) for pose in poses]
    assert likelihood.score(poses, reads).nll == pytest.approx(expected)
    assert likelihood.log_likelihood(poses, reads) == pytest.approx(-np.array(expected))


@given(seed=st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_gradient_is_that_of_the_value_and_information_is_never_indefinite(seed: int) -> None:
    rng = np.random.default_rng(seed)
    likelihood = PhaseLikelihood(PhaseModel(ANTENNAS), world(rng))
    reads = simulated(rng, likelihood.tags, 60, noise=rng.uniform(0.0, 2.0))
    pose = se2.compose(POSE, se2.exp(rng.normal(0.0, 0.1, 3)))
    score = likelihood.score(pose, reads)
    numeric = by_pose(lambda p: likelihood.score(p, reads).nll[0], pose)
    assert np.allclose(score.gradient[0], numeric, rtol=1e-4, atol=1e-4)
    assert np.allclose(score.information[0], score.information[0].T)
    assert np.linalg.eigvalsh(score.information[0]).min() > -1e-9 * np.trace(score.information[0])


def test_information_is_the_hessian_at_clean_phases(likelihood: PhaseLikelihood) -> None:
    reads = simulated(np.random.default_rng(3), likelihood.tags, noise=0.0)
    score = likelihood.score(POSE, reads)
    hessian = by_pose(lambda p: likelihood.score(p, reads).gradient[0], POSE, 1e-5)
    assert np.allclose(score.information[0], hessian, atol=1e-3 * np.trace(hessian))
    assert np.allclose(score.gradient, 0.0, atol=1e-6)


def test_offsets_and_flips_do_not_matter(likelihood: PhaseLikelihood) -> None:
    rng = np.random.default_rng(4)
    reads = simulated(rng, likelihood.tags)
    offsets = rng.uniform(0.0, 6.0, (2, len(likelihood.tags.points)))[reads.antennas, reads.tags]
    other = replace(reads, phase=reads.phase + offsets + np.pi * rng.integers(0, 2, len(offsets)))
    ours, theirs = likelihood.score(POSE, reads), likelihood.score(POSE, other)
    assert theirs.nll == pytest.approx(ours.nll)
    assert theirs.gradient[0] == pytest.approx(ours.gradient[0])


def test_groups_are_of_one_tag_antenna_channel_and_window(likelihood: PhaseLikelihood) -> None:
    reads = simulated(np.random.default_rng(5), likelihood.tags, 4)
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


def test_far_reads_and_small_groups_are_left_out(likelihood: PhaseLikelihood) -> None:
    points = np.array([(0.5, -1.5, 0.8), (0.5, -9.0, 0.8), (0.2, -1.5, 0.8)])
    model = replace(likelihood.model, max_range=2.5, min_reads=3)
    three = PhaseLikelihood(model, TagArray(points, np.full(3, np.nan)))
    tags = np.array((0, 0, 0, 1, 1, 1, 2, 2))
    reads = PhaseReads(
        np.zeros((8, 3)), np.zeros(8, np.int64), tags, np.zeros(8), np.full(8, FREQUENCY), np.zeros(8, np.int64)
    )
    assert three.near(POSE, reads).tags.tolist() == [0, 0, 0]
    none = three.near(np.array((50.0, 0.0, 0.0)), reads)
    assert len(none.tags) == 0
    assert not any(part.any() for part in three.score(POSE, none))
    assert not three.log_likelihood(POSE[None], none).any()


def test_reads_can_be_placed_around_another_pose(likelihood: PhaseLikelihood) -> None:
    reads = simulated(np.random.default_rng(7), likelihood.tags)
    step = np.array((0.5, -0.1, 0.3))
    before = se2.compose(POSE, se2.inverse(step))
    assert likelihood.score(before, reads.moved(step)).nll == pytest.approx(likelihood.score(POSE, reads).nll)

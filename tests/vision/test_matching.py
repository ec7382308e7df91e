"""Matching, against its definition in plain loops, and on descriptors of which the answer is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorgraph_loc.errors import InputError
from factorgraph_loc.vision.matching import Matches, distance_matrix, gates, match

pytestmark = pytest.mark.kernels


def by_definition(distances: np.ndarray, ratio: float) -> list[tuple[int, int]]:
    found = []
    for i, row in enumerate(distances):
        j = int(np.argmin(row))
        second = min((d for k, d in enumerate(row) if k != j), default=np.inf)
        if row[j] < ratio * second and np.argmin(distances[:, j]) == i:
            found.append((i, j))
    return found


def pairs(matches: Matches) -> list[tuple[int, int]]:
    return [tuple(row) for row in matches.indices.tolist()]


@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 20),
    m=st.integers(1, 20),
    ratio=st.sampled_from([0.2, 0.8, 1.0, 5.0]),
)
def test_matches_are_those_of_the_definition(seed: int, n: int, m: int, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(n, 3)).astype(np.float32), rng.normal(size=(m, 3)).astype(np.float32)
    distances = np.linalg.norm(a[:, None].astype(float) - b, axis=2)
    found = match(a, b, ratio=ratio)
    assert pairs(found) == by_definition(distances, ratio)
    assert np.allclose(found.distances, distances[tuple(found.indices.T)], atol=2e-3)


def test_bits_are_compared_by_how_many_differ() -> None:
    rng = np.random.default_rng(1)
    a, b = (rng.integers(0, 256, (n, 32), dtype=np.uint8) for n in (30, 40))
    expected = np.array([[np.unpackbits(x ^ y).sum() for y in b] for x in a])
    assert np.array_equal(distance_matrix(a, b), expected)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 512.0])
@pytest.mark.parametrize("columns", [16, 35, 128])
def test_equal_descriptors_are_no_distance_apart_and_no_match(scale: float, columns: int) -> None:
    """However a processor rounds: among many pairs some would be a little apart."""
    rng = np.random.default_rng(5)
    looks = (scale * rng.normal(size=(200, columns))).astype(np.float32)
    distances = distance_matrix(looks, np.concatenate((looks, looks)))
    assert not distances[np.arange(200), np.arange(200)].any()
    assert not distances[np.arange(200), 200 + np.arange(200)].any()
    assert np.count_nonzero(distances == 0.0) == 400
    twice = np.concatenate((looks, looks))
    for ratio in (0.8, 1.0, 5.0):
        assert len(match(looks, twice, ratio=ratio)) == 0
        assert len(match(twice, looks, ratio=ratio)) == 0
    assert len(match(looks, looks)) == 200


def test_what_is_as_far_from_two_is_no_match() -> None:
    rng = np.random.default_rng(6)
    looks = rng.normal(size=(50, 32)).astype(np.float32)
    off = 0.05 * rng.normal(size=(50, 32)).astype(np.float32)
    beside = np.concatenate((looks + off, looks - off))
    assert len(match(looks, beside, ratio=5.0)) == 0
    assert len(match(beside, looks)) == 0
    bits = np.array([[0b1111], [0b0000]], dtype=np.uint8)
    assert len(match(bits, np.array([[0b0011]], dtype=np.uint8))) == 0


def test_a_gate_holds_its_probability() -> None:
    rng = np.random.default_rng(4)
    mean, covariance = np.array([30.0, 40.0]), np.array([[9.0, 3.0], [3.0, 4.0]])
    points = rng.multivariate_normal(mean, covariance, 20_000)
    inside = gates(mean[None], covariance[None], points)
    # five standard deviations of a binomial: wrong once in two million runs
    assert abs(inside.mean() - 0.99) < 5.0 * np.sqrt(0.99 * 0.01 / 20_000)


def test_guided_matching_looks_only_inside_the_gates() -> None:
    descriptors = np.eye(3, 4, dtype=np.float32)
    predicted = np.array([[10.0, 10.0], [50.0, 50.0], [np.nan, np.nan]])
    covariances = np.tile(4.0 * np.eye(2), (3, 1, 1))
    # the point that looks like the first is far from where the first should be, and one like the second near by
    points = np.array([[90.0, 90.0], [11.0, 9.0], [49.0, 50.0], [10.0, 12.0]])
    seen = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0.9, 0, 0], [0.7, 0, 0.5, 0]], dtype=np.float32)
    free = match(descriptors, seen, ratio=1.0)
    assert pairs(free) == [(0, 0), (1, 1)]
    guided = match(descriptors, seen, allowed=gates(predicted, covariances, points))
    assert pairs(guided) == [(0, 3), (1, 2)]


@pytest.mark.parametrize("n", [0, 4])
def test_nothing_matches_nothing(n: int) -> None:
    some, none = np.ones((4, 35), dtype=np.float32), np.empty((0, 35), dtype=np.float32)
    for a, b in ((some[:n], none), (none, some[:n])):
        found = match(a, b)
        assert len(found) == 0
        assert found.indices.shape == (0, 2)
    no_points = np.empty((0, 2))
    assert len(match(none, none, allowed=gates(no_points, np.empty((0, 2, 2)), no_points))) == 0


def test_bad_input_is_an_error() -> None:
    floats, bits = np.ones((2, 35), dtype=np.float32), np.ones((2, 32), dtype=np.uint8)
    with pytest.raises(InputError, match="descriptors have 35 and 128 columns"):
        match(floats, np.ones((2, 128), dtype=np.float32))
    with pytest.raises(InputError, match="descriptors are float32 and uint8, expected uint8 for both or for none"):
        match(floats[:, :32], bits)
    with pytest.raises(InputError, match=r"first descriptors have shape \(35,\), expected \(N, D\)"):
        match(floats[0], floats)
    with pytest.raises(InputError, match="second descriptors have values that are not finite"):
        match(floats, np.full((1, 35), np.nan, dtype=np.float32))
    with pytest.raises(InputError, match=r"ratio is 0.0, expected more than 0"):
        match(floats, floats, ratio=0.0)
    with pytest.raises(InputError, match=r"allowed has shape \(1, 2\), expected \(2, 2\)"):
        match(floats, floats, allowed=np.ones((1, 2), dtype=bool))
    with pytest.raises(InputError, match=r"covariance 1 is .* expected positive definite"):
        gates(np.zeros((2, 2)), np.array([np.eye(2), -np.eye(2)]), np.zeros((1, 2)))

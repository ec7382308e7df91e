"""Compiled loops, against the same in plain numpy."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from factorgraph_loc.vision.kernels import (
    lonely,
    refined_peaks,
)


def peaks_of(strength: np.ndarray, planes: np.ndarray, threshold: float = 0.0) -> np.ndarray:
    peaks = np.empty((1, 5))
    pixels = np.array([[6, 5]], dtype=np.int32)
    count = refined_peaks(strength, threshold, planes, np.array([0.5, 1.0, 2.0]), pixels, peaks)
    return peaks[:count]


def cones(heights: tuple[float, float, float]) -> np.ndarray:
    """Planes whose Laplacian at (6, 5) is -4 times the heights, weighted as in peaks_of."""
    planes = np.zeros((3, 11, 13), dtype=np.float32)
    planes[:, 5, 6] = np.array(heights) / np.array([0.5, 1.0, 2.0])
    return planes


def test_a_paraboloid_gives_its_own_vertex() -> None:
    y, x = np.mgrid[:11, :13]
    strength = (9.0 - (x - 6.3) ** 2 - 2.0 * (y - 4.8) ** 2 + 0.5 * (x - 6.3) * (y - 4.8)).astype(np.float32)
    # Laplacians 4, 5, 3: the parabola through them has its vertex at -1/6
    (peak,) = peaks_of(strength, cones((1.0, 1.25, 0.75)))
    assert np.allclose(peak[:3], (6.3, 4.8, -1.0 / 6.0), atol=1e-4)
    assert np.allclose(peak[3:], (strength[5, 6], 5.0))


def test_what_is_weak_or_stronger_at_another_scale_is_dropped() -> None:
    y, x = np.mgrid[:11, :13]
    strength = (9.0 - (x - 6.0) ** 2 - (y - 5.0) ** 2).astype(np.float32)
    assert len(peaks_of(strength, cones((1.0, 1.25, 0.75)))) == 1
    assert len(peaks_of(strength, cones((1.0, 1.25, 0.75)), threshold=9.0)) == 0
    assert len(peaks_of(strength, cones((1.5, 1.25, 0.75)))) == 0
    assert len(peaks_of(strength, cones((1.0, 1.25, 1.5)))) == 0


@settings(max_examples=50)
@given(seed=st.integers(0, 2**32 - 1), total=st.integers(0, 40), count=st.integers(1, 50), reach=st.floats(0.1, 5.0))
def test_lonely_points_are_those_of_the_definition(seed: int, total: int, count: int, reach: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 10.0, (total, 2)).astype(np.float32)
    scales = np.exp2(rng.uniform(0.0, 2.0, total)).astype(np.float32)
    free = []
    for n in range(total):
        distance = np.linalg.norm(points[:n] - points[n], axis=1)
        alike = np.abs(np.log2(scales[:n] / scales[n])) <= 0.5
        if not np.any(alike & (distance < reach * scales[n])):
            free.append(n)
    assert np.flatnonzero(lonely(points, scales, reach, 2.0**0.5, count)).tolist() == free[:count]

"""Compiled loops, against the same in plain numpy."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from factorgraph_loc.vision.kernels import (
    corner_strength,
    lonely,
    orientation_histograms,
    refined_peaks,
    sample_patches,
    structure_tensor,
)


def random_planes(*shape: int) -> np.ndarray:
    return np.random.default_rng(sum(shape)).normal(size=shape).astype(np.float32)


def test_structure_tensor_sums_products_of_central_differences() -> None:
    planes = random_planes(3, 12, 17)
    products = np.full((3, 12, 17), np.nan, dtype=np.float32)
    structure_tensor(planes[0], planes[1:], products)
    padded = np.pad(planes, ((0, 0), (1, 1), (0, 0)), mode="edge")
    dy = 0.5 * (padded[:, 2:] - padded[:, :-2])
    dx = np.zeros_like(planes)
    dx[:, :, 1:-1] = 0.5 * (planes[:, :, 2:] - planes[:, :, :-2])
    dy[:, :, [0, -1]] = 0.0
    expected = [(dx * dx).sum(axis=0), (dx * dy).sum(axis=0), (dy * dy).sum(axis=0)]
    assert np.allclose(products, expected, atol=1e-5)


def test_corner_strength_is_determinant_over_trace() -> None:
    roots = random_planes(2, 2, 30, 40).astype(float)
    moments = np.einsum("ikyx,jkyx->yxij", roots, roots)  # positive definite
    products = np.stack([moments[..., 0, 0], moments[..., 0, 1], moments[..., 1, 1]]).astype(np.float32)
    strength = np.empty((30, 40), dtype=np.float32)
    corner_strength(products, np.float32(2.0), strength)
    expected = 2.0 / (1.0 / np.linalg.eigvalsh(moments)).sum(axis=2)
    assert np.allclose(strength, expected, rtol=1e-3, atol=1e-4)


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


def test_patches_are_bilinear_samples_in_the_frame_of_a_point() -> None:
    planes = [random_planes(9, 14), random_planes(21, 8)]
    flat = np.concatenate([plane.ravel() for plane in planes])
    which = np.array([0, 1, 1])
    starts, shapes = np.array([0, 9 * 14])[which], np.array([(9, 14), (21, 8)])[which]
    frames = np.array([[6.2, 4.1, 1.5, 0.5], [3.0, 10.0, 0.0, 2.0], [0.0, 20.0, 1.0, 0.0]], dtype=np.float32)
    offsets = np.stack(np.meshgrid(np.arange(-2.0, 3.0), np.arange(-2.0, 3.0)), axis=-1).reshape(-1, 2)
    patches = np.empty((3, 25), dtype=np.float32)
    sample_patches(flat, starts, shapes, frames, offsets.astype(np.float32), patches)
    for patch, (x, y, a, b), plane in zip(patches, frames, [planes[i] for i in which], strict=True):
        places = np.array([x, y]) + offsets @ np.array([[a, b], [-b, a]])
        expected = map_coordinates(plane, places.T[::-1], order=1, mode="nearest")
        assert np.allclose(patch, expected, atol=1e-5)


def test_a_histogram_holds_each_gradient_in_its_two_nearest_bins() -> None:
    side, bins = 7, 12
    patch = random_planes(1, side * side)
    weights = np.abs(random_planes(side - 2, side - 2))
    histogram = np.zeros((1, bins), dtype=np.float32)
    orientation_histograms(patch, side, weights, histogram)
    square = patch[0].reshape(side, side)
    dx, dy = square[1:-1, 2:] - square[1:-1, :-2], square[2:, 1:-1] - square[:-2, 1:-1]
    centres = 2.0 * np.pi * np.arange(bins) / bins
    away = np.angle(np.exp(1j * (np.arctan2(dy, dx)[..., None] - centres))) / (2.0 * np.pi / bins)
    share = np.maximum(1.0 - np.abs(away), 0.0)
    expected = (share * (np.hypot(dx, dy) * weights)[..., None]).sum(axis=(0, 1))
    assert np.allclose(histogram[0], expected, rtol=1e-4, atol=1e-5)

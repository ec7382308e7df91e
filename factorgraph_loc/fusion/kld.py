"""The number of particles that a distribution needs, by KLD sampling (Fox, IJRR 22(12), 2003), and kernels around particles."""

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.fusion.cloud import cell_numbers
from factors import se2
from factors.se2 import Array

# Bound of the Kullback-Leibler divergence, and the normal quantile of the probability (99 %) that the divergence is smaller.
ERROR, QUANTILE = 0.05, 2.326
CELL = np.array((0.3, 0.3, 0.2))  # m, m, rad; size of the cells that are counted
KERNEL = 0.25  # standard deviation of a kernel as a fraction of the distance between particles


def enough(cells: Array | NDArray[np.int64]) -> Array:
    """Return the number of particles that KLD sampling needs. ``cells``: the number of occupied grid cells. Source:
    Fox, 2003, eq. 7, with the approximation of Wilson and Hilferty."""
    freedom = np.maximum(np.asarray(cells, dtype=float) - 1.0, 1.0)
    a = 2.0 / (9.0 * freedom)
    return np.asarray(freedom / (2.0 * ERROR) * (1.0 - a + np.sqrt(a) * QUANTILE) ** 3)


def prefix(poses: Array, rng: np.random.Generator, least: int) -> NDArray[np.int64]:
    """Return the indices of a random subset of ``poses`` (N, 3), chosen by KLD sampling. It has at least ``least``
    poses, or all if N is smaller.

    Poses are added in random order, until their number is :func:`enough` for the number of grid cells that they occupy.
    """
    order = rng.permutation(len(poses))
    _, first = np.unique(cell_numbers(poses[order], CELL), return_index=True)
    occupied = np.searchsorted(np.sort(first), np.arange(1, len(poses) + 1), side="left")
    needed = enough(np.arange(len(first) + 1))[occupied]
    reached = np.arange(1, len(poses) + 1) >= np.maximum(needed, least)
    return np.asarray(order[: int(np.argmax(reached)) + 1] if reached.any() else order)


def jittered(poses: Array, rows: NDArray[np.int64], rng: np.random.Generator, room: Array | float = 0.0) -> Array:
    """Return poses (K, 3), each drawn from a Gaussian kernel around one of the ``poses`` (N, 3). ``rows`` (K,): the
    indices of the kernels' centres.

    The kernel's width is proportional to the cube root of the volume per particle. This volume is the number of
    occupied grid cells, divided by the number of distinct centres. ``room`` (K,): a lower limit of this volume for each
    new pose, in grid cells.
    """
    chosen = poses[rows]
    cells = len(np.unique(cell_numbers(chosen, CELL)))
    width = KERNEL * np.cbrt(np.maximum(room, cells / len(np.unique(rows))))
    noise = rng.standard_normal(chosen.shape) * CELL * np.reshape(width, (-1, 1))
    return se2.compose(chosen, se2.exp(noise))

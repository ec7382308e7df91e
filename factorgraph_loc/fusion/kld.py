"""How many particles a density needs: KLD sampling (Fox, IJRR 22(12), 2003); and kernels as wide as befits their number."""

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.fusion.cloud import cell_numbers
from factors import se2
from factors.se2 import Array

ERROR, QUANTILE = 0.05, 2.326  # the largest Kullback-Leibler divergence, kept to with a probability of 99 %
CELL = np.array((0.3, 0.3, 0.2))  # m, m, rad
KERNEL = 0.25  # of the distance between particles


def enough(cells: Array | NDArray[np.int64]) -> Array:
    """The particles that a density over so many occupied cells needs (Fox, 2003, eq. 7, by Wilson and Hilferty)."""
    freedom = np.maximum(np.asarray(cells, dtype=float) - 1.0, 1.0)
    a = 2.0 / (9.0 * freedom)
    return np.asarray(freedom / (2.0 * ERROR) * (1.0 - a + np.sqrt(a) * QUANTILE) ** 3)


def prefix(poses: Array, rng: np.random.Generator, least: int) -> NDArray[np.int64]:
    """Places among draws (N, 3) of as many as are enough, at least ``least``: in random order they are taken one by one until their
    number is enough for the cells that they have occupied."""
    order = rng.permutation(len(poses))
    _, first = np.unique(cell_numbers(poses[order], CELL), return_index=True)
    occupied = np.searchsorted(np.sort(first), np.arange(1, len(poses) + 1), side="left")
    needed = enough(np.arange(len(first) + 1))[occupied]
    reached = np.arange(1, len(poses) + 1) >= np.maximum(needed, least)
    return np.asarray(order[: int(np.argmax(reached)) + 1] if reached.any() else order)


def jittered(poses: Array, rows: NDArray[np.int64], rng: np.random.Generator, room: Array | float = 0.0) -> Array:
    """Particles (K, 3) drawn from kernels on the particles ``rows`` (K,) of ``poses`` (N, 3), as wide as befits how densely those,
    each of them once, lie in the cells; or, where they are farther apart, the ``room`` (K,), in cells, that each had for itself.
    Of several modes each keeps its width."""
    chosen = poses[rows]
    cells = len(np.unique(cell_numbers(chosen, CELL)))
    width = KERNEL * np.cbrt(np.maximum(room, cells / len(np.unique(rows))))
    noise = rng.standard_normal(chosen.shape) * CELL * np.reshape(width, (-1, 1))
    return se2.compose(chosen, se2.exp(noise))

"""A histogram filter of the pose. Up to the resolution of its grid it is optimal, and serves as a reference for other filters.

It is slow and suitable for small rooms only (Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, section 8.2). The grid has a
layer per heading. Motions of less than a cell would diffuse the density. Therefore each layer has its own offset, and the
reported motion moves the layers exactly. The noise of the motion is much smaller than a cell and is applied by a kernel with the
same mean and covariance. Probability mass that moves to a layer with another offset is distributed over four cells per axis by
Lagrange weights. These preserve its moments up to the third.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.model.belief import PosePrior
from factors import se2
from factors.compiled import compiled
from factors.motion import Increment
from factors.se2 import Array

CELL = 0.05  # m
HEADINGS = 120  # layers, of 3 degrees
NEGLIGIBLE = 1e-13  # relative to the largest cell: smaller values are set to zero
LARGEST_SHARE = (
    0.25  # largest fraction of a cell's mass that leaves the cell in one step; larger noise needs several steps
)


class GridFilter:
    """The probability density of a pose on a grid, in the rectangle from ``low`` (2,) to ``high`` (2,) [m]. Mass outside is lost.

    ``cell`` [m]: the distance of the points of the grid. ``headings``: their number of headings. Variances are accurate to 0.3 % if
    standard deviations are above 0.7 of a cell.
    """

    def __init__(
        self, prior: PosePrior, low: Array, high: Array, *, cell: float = CELL, headings: int = HEADINGS
    ) -> None:
        self._cell, self._low = cell, np.asarray(low, dtype=float)
        self._step = 2.0 * math.pi / headings
        self._first = 0.0  # heading of the first layer
        shape = np.ceil((np.asarray(high) - self._low) / cell).astype(int) + 1
        self._offsets = np.zeros((headings, 2))  # offset of each layer, in cells
        self._mass = np.ones((headings, *shape))
        precision = np.linalg.inv(prior.covariance)

        def density(poses: Array) -> Array:
            error = poses - prior.pose
            error[:, 2] = se2.wrap(error[:, 2])
            return np.asarray(-0.5 * np.einsum("ni,ij,nj->n", error, precision, error))

        self.update(density)

    def predict(self, increment: Increment) -> None:
        """Predict the density by a motion of the odometry."""
        headings = self._headings()
        c, s = np.cos(headings), np.sin(headings)
        dx, dy, turn = increment.delta
        self._offsets += np.column_stack((c * dx - s * dy, s * dx + c * dy)) / self._cell
        self._first = se2.wrap_scalar(self._first + turn)
        covariance = increment.covariance
        leaving = max(covariance[2, 2] / self._step**2, (covariance[0, 0] + covariance[1, 1]) / self._cell**2)
        passes = math.ceil(leaving / LARGEST_SHARE)
        for _ in range(passes):
            self._spread(covariance / passes)

    def update(self, log_likelihood: Callable[[Array], Array]) -> None:
        """Multiply the density by a likelihood. ``log_likelihood``: a function that returns its logarithm (N,) at poses (N, 3)."""
        rows = np.nonzero(self._mass)
        values = log_likelihood(self._poses(rows))
        mass = self._mass[rows] * np.exp(values - np.max(values))
        mass[np.abs(mass) < NEGLIGIBLE * mass.max()] = 0.0
        self._mass[rows] = mass / mass.sum()

    def moments(self) -> tuple[Array, Array]:
        """Return the mean (3,) and the covariance (3, 3) of x, y and heading in the world frame."""
        rows = np.nonzero(self._mass)
        poses, mass = self._poses(rows), self._mass[rows]
        heading = math.atan2(float(mass @ np.sin(poses[:, 2])), float(mass @ np.cos(poses[:, 2])))
        error = poses - (0.0, 0.0, heading)
        error[:, 2] = se2.wrap(error[:, 2])
        mean = mass @ error
        error -= mean
        mean[2] = se2.wrap_scalar(mean[2] + heading)
        return mean, np.asarray((error * mass[:, None]).T @ error)

    def _headings(self) -> Array:
        return np.asarray(self._first + self._step * np.arange(len(self._mass)), dtype=float)

    def _poses(self, rows: tuple[NDArray[np.int64], ...]) -> Array:
        layer, i, j = rows
        x = self._low[0] + self._cell * (i + self._offsets[layer, 0])
        y = self._low[1] + self._cell * (j + self._offsets[layer, 1])
        return np.asarray(np.column_stack((x, y, se2.wrap(self._headings()[layer]))), dtype=float)

    def _spread(self, covariance: Array) -> None:
        """Add noise with a body-frame ``covariance`` (3, 3) to the pose."""
        variance = float(covariance[2, 2])
        share = variance / (2.0 * self._step**2)
        # regression of the position on the heading, and the remaining noise
        slope = covariance[:2, 2] / variance if variance > 0.0 else np.zeros(2)
        rest = covariance[:2, :2] - variance * np.outer(slope, slope)
        headings = self._headings()
        c, s = np.cos(headings), np.sin(headings)
        turned: Array = np.moveaxis(np.array(((c, -s), (s, c))), 2, 0)
        aside = self._step * (turned @ slope) / self._cell
        within = turned @ rest @ np.swapaxes(turned, 1, 2) / self._cell**2
        whole = np.rint(self._offsets)
        self._offsets -= whole
        self._mass = _spread(self._mass, whole.astype(np.int64), self._offsets, share, aside, within)
        # small negative values are kept, because only weights of both signs preserve the moments
        self._mass[np.abs(self._mass) < NEGLIGIBLE * self._mass.max()] = 0.0
        self._mass /= self._mass.sum()


@compiled
def _spread(mass: Array, whole: Array, offsets: Array, share: float, aside: Array, within: Array) -> Array:
    """Return the mass (K, X, Y) of K layers after motion and noise.

    The mass of a layer moves by ``whole`` (K, 2) cells. The fraction ``share`` of it moves to each adjacent layer, and there by
    ``aside`` (K, 2) cells. Finally it is distributed over neighbouring cells with the covariance ``within`` (K, 2, 2) [cells^2].
    ``offsets`` (K, 2): the offsets of the layers in cells.
    """
    layers, nx, ny = mass.shape
    turned = np.zeros_like(mass)
    for k in range(layers):
        for i in range(nx):
            for j in range(ny):
                value = mass[k, i, j]
                if value == 0.0:
                    continue
                a, b = i + whole[k, 0], j + whole[k, 1]
                if 0 <= a < nx and 0 <= b < ny:
                    turned[k, a, b] += (1.0 - 2.0 * share) * value
                if share <= 0.0:
                    continue
                for sign in (-1, 1):
                    to = (k + sign) % layers
                    x = a + offsets[k, 0] - offsets[to, 0] + sign * aside[k, 0]
                    y = b + offsets[k, 1] - offsets[to, 1] + sign * aside[k, 1]
                    _divide(turned[to], x, y, share * value)
    out = np.zeros_like(mass)
    for k in range(layers):
        xx, xy, yy = within[k, 0, 0], within[k, 0, 1], within[k, 1, 1]
        for i in range(1, nx - 1):
            for j in range(1, ny - 1):
                value = turned[k, i, j]
                if value == 0.0:
                    continue
                out[k, i, j] += (1.0 - xx - yy) * value
                for sign in (-1, 1):
                    out[k, i + sign, j] += 0.5 * xx * value
                    out[k, i, j + sign] += 0.5 * yy * value
                    out[k, i + sign, j + sign] += 0.25 * xy * value
                    out[k, i + sign, j - sign] -= 0.25 * xy * value
    return out


@compiled
def _divide(layer: Array, x: float, y: float, value: float) -> None:
    """Add ``value`` to a layer at the position (x, y) between cells. It is distributed over the 4 x 4 nearest cells."""
    nx, ny = layer.shape
    i, j = math.floor(x), math.floor(y)
    wx, wy = np.empty(4), np.empty(4)
    _lagrange(x - i, wx)
    _lagrange(y - j, wy)
    for a in range(4):
        for b in range(4):
            if 0 <= i + a - 1 < nx and 0 <= j + b - 1 < ny:
                layer[i + a - 1, j + b - 1] += wx[a] * wy[b] * value


@compiled
def _lagrange(f: float, out: Array) -> None:
    """Write the Lagrange weights (4,) of the points -1, 0, 1, 2 for a position ``f`` between 0 and 1 to ``out``."""
    out[0] = -f * (f - 1.0) * (f - 2.0) / 6.0
    out[1] = (f + 1.0) * (f - 1.0) * (f - 2.0) / 2.0
    out[2] = -(f + 1.0) * f * (f - 2.0) / 2.0
    out[3] = (f + 1.0) * f * (f - 1.0) / 6.0

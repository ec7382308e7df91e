"""Reads and misses of one tag with unknown position, as a factor on a pose and that position."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.compressed import compressed
from factors.rfid.counts import TagReadCounts
from factors.rfid.detection import RfidLikelihood
from factors.rfid.kernels import of_tag, placed, terms
from factors.rfid.model import Packed
from factors.se2 import Array

ROWS = 6  # of the residual
UNKNOWNS = 5


@dataclass(frozen=True, eq=False)
class RfidTagFactor:
    """The likelihood of read counts of tag number ``tag`` of ``likelihood``, as a factor on the pose (3,) and the tag's position
    (2,) in the world, in compressed Fisher form (:mod:`factors.compressed`): six residuals.

    Height and facing of the tag are those in ``likelihood``; its position there is not used.
    """

    likelihood: RfidLikelihood
    tag: int
    looks: TagReadCounts

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Residual (6,) and its Jacobians (6, 3) by the pose and (6, 2) by the position."""
        nll, gradient, information = self.score(values)
        residual, jacobian = compressed(nll, gradient, information)
        return residual, [jacobian[:, :3], jacobian[:, 3:]]

    def cost(self, values: Sequence[Array]) -> float:
        """The tempered negative log-likelihood."""
        return self.score(values)[0]

    def score(self, values: Sequence[Array]) -> tuple[float, Array, Array]:
        """Tempered negative log-likelihood, its gradient (5,) and Fisher information (5, 5) by the body-frame perturbation of the
        pose and the position in the world."""
        gradient, information = np.zeros(UNKNOWNS), np.zeros((UNKNOWNS, UNKNOWNS))
        tags, looks = self.likelihood.tags, self.looks
        point = np.array((values[1][0], values[1][1], tags.points[self.tag, 2]))
        arrays = (looks.offsets, looks.antennas, looks.rounds, looks.hits)
        pose = np.asarray(values[0], dtype=float)
        normal = tags.normals[self.tag]
        packed = self.likelihood.packed
        nll = _joint(packed, pose, point, normal, *arrays, self.tag, gradient, information)
        alpha = self.likelihood.model.tempering
        return alpha * nll, alpha * gradient, alpha * information


@compiled
def _joint(
    packed: Packed,
    pose: Array,
    point: Array,
    normal: Array,
    offsets: Array,
    antennas: NDArray[np.int64],
    rounds: NDArray[np.int64],
    hits: NDArray[np.int64],
    tag: int,
    gradient: Array,
    information: Array,
) -> float:
    c0, s0 = math.cos(pose[2]), math.sin(pose[2])
    by = np.empty(5)
    nll = 0.0
    for k in range(len(antennas)):
        a = antennas[k]
        x, y, c, s, _, _ = placed(packed, a, pose, offsets[k])
        z, by_p, by_q, by_heading, _ = of_tag(packed, a, x, y, c, s, point, normal)
        e, g, f, _, _ = terms(packed, z, packed.rate[packed.which[a]], hits[k, tag], rounds[k])
        nll += e
        if f == 0.0 and g == 0.0:
            continue
        # by the tag's position in the world, and in the frame of the pose
        wx, wy = c * by_p - s * by_q, s * by_p + c * by_q
        gx, gy = c0 * wx + s0 * wy, c0 * wy - s0 * wx
        # the antenna's position in the frame of the pose
        px, py = c0 * (x - pose[0]) + s0 * (y - pose[1]), c0 * (y - pose[1]) - s0 * (x - pose[0])
        by[0], by[1], by[2], by[3], by[4] = -gx, -gy, by_heading + gx * py - gy * px, wx, wy
        for i in range(5):
            gradient[i] += g * by[i]
            for j in range(5):
                information[i, j] += f * by[i] * by[j]
    return nll

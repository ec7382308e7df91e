"""The likelihood of the signal strength of RFID reads: log-distance path loss with the antenna's pattern.

``rssi = a0 - 10 a1 log10(d) + a2 w + a3 w^2 + a4 c + a5 c^2`` [dBm], with the distance d [m] from the antenna to the tag,
w = 1 - cosine of the angle from the boresight, and c the cosine of the angle between the tag's facing and the direction to the
antenna (0 if unknown): Rappaport, "Wireless Communications", 2002, eq. 4.69a, with a series for the gains. Residuals have a Student
density, because reflections cause outliers (Lange, Little, Taylor, JASA 84, 1989); its Fisher information is
``(dof + 1) / (dof + 3) / sigma^2``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.compiled import compiled
from factors.rfid.detection import TagArray
from factors.rfid.model import Antenna
from factors.se2 import Array

Integers = NDArray[np.int64]
FEATURES = ("1", "-10 log10 d", "w", "w^2", "c", "c^2")
NEAR = 0.1  # m; minimum distance of the path loss
DECIBEL = 10.0 / math.log(10.0)


@dataclass(frozen=True, eq=False)
class RssiReads:
    """R reads, each at its own pose.

    ``offsets`` (R, 3): the robot's pose at the read, in the frame of the likelihood's pose; ``antennas`` (R,) and ``tags`` (R,):
    indices in the model and in the map; ``rssi`` (R,) [dBm].
    """

    offsets: Array
    antennas: Integers
    tags: Integers
    rssi: Array

    def moved(self, offset: Array) -> RssiReads:
        """The reads relative to the pose that lies ``offset`` (3,) before theirs."""
        return replace(self, offsets=se2.compose(offset, self.offsets))

    def chosen(self, which: NDArray[np.bool_] | Integers) -> RssiReads:
        """The selected reads."""
        return RssiReads(*(getattr(self, f.name)[which] for f in fields(self)))


@dataclass(frozen=True)
class RssiModel:
    """``antennas``: their mounting; ``coefficients`` (6,) in the order of :data:`FEATURES`; ``sigma`` [dB] and ``dof``: of the
    Student density; ``tempering``: exponent of the likelihood, for correlated reads."""

    antennas: tuple[Antenna, ...]
    coefficients: Sequence[float]
    sigma: float
    dof: float
    tempering: float = 1.0


class RssiScore(NamedTuple):
    """Tempered likelihoods of N poses. ``nll`` (N,), relative to zero residuals, so never negative; ``gradient`` (N, 3) and
    ``information`` (N, 3, 3) by body-frame perturbation."""

    nll: Array
    gradient: Array
    information: Array


@dataclass(frozen=True, eq=False)
class RssiLikelihood:
    """The likelihood of a strength model with a map of tags."""

    model: RssiModel
    tags: TagArray
    _antennas: Array = field(init=False, repr=False)
    _coefficients: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_antennas", placed(self.model.antennas))
        object.__setattr__(self, "_coefficients", np.array(self.model.coefficients, dtype=float))

    def score(self, poses: Array, reads: RssiReads) -> RssiScore:
        """Likelihood, gradient and information at poses (N, 3)."""
        poses = np.ascontiguousarray(np.atleast_2d(poses), dtype=float)
        n, m = len(poses), self.model
        out = RssiScore(np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3, 3)))
        model = (self._antennas, self.tags.points, self.tags.normals, self._coefficients)
        _score(*model, m.sigma, m.dof, poses, reads.offsets, reads.antennas, reads.tags, reads.rssi, *out)
        return RssiScore(*(m.tempering * part for part in out))

    def log_likelihood(self, poses: Array, reads: RssiReads) -> Array:
        """Tempered log-likelihood (N,) at poses (N, 3), up to a constant, for particles."""
        m = self.model
        out = np.zeros(len(poses))
        poses = np.ascontiguousarray(poses, dtype=float)
        model = (self._antennas, self.tags.points, self.tags.normals, self._coefficients)
        _log_likelihood(*model, m.sigma, m.dof, poses, reads.offsets, reads.antennas, reads.tags, reads.rssi, out)
        return m.tempering * out


def placed(antennas: Sequence[Antenna]) -> Array:
    """Position and boresight (A, 6) of antennas in the robot frame."""
    rows = [
        (a.x, a.y, a.z, math.cos(a.yaw) * math.cos(a.pitch), math.sin(a.yaw) * math.cos(a.pitch), math.sin(a.pitch))
        for a in antennas
    ]
    return np.array(rows).reshape(-1, 6)


def features(antennas: Sequence[Antenna], tags: TagArray, pose: Array, reads: RssiReads) -> Array:
    """The :data:`FEATURES` (R, 6) of reads at a pose (3,)."""
    out = np.empty((len(reads.tags), len(FEATURES)))
    by = np.empty((len(FEATURES), 3))
    rows = placed(antennas)
    pose = np.asarray(pose, dtype=float)
    for r in range(len(out)):
        a, t = reads.antennas[r], reads.tags[r]
        _features(rows[a], tags.points[t], tags.normals[t], pose, reads.offsets[r], out[r], by)
    return out


@compiled
def _features(antenna: Array, point: Array, normal: Array, pose: Array, offset: Array, out: Array, by: Array) -> None:
    """Features (6,) and their derivatives (6, 3) by the pose's body-frame perturbation."""
    c0, s0 = math.cos(pose[2]), math.sin(pose[2])
    co, so = math.cos(offset[2]), math.sin(offset[2])
    # in the frame of the pose: the antenna, its boresight, the vector to the tag, the tag's normal
    px, py = offset[0] + co * antenna[0] - so * antenna[1], offset[1] + so * antenna[0] + co * antenna[1]
    bx, by_, bz = co * antenna[3] - so * antenna[4], so * antenna[3] + co * antenna[4], antenna[5]
    wx, wy = point[0] - pose[0], point[1] - pose[1]
    ex, ey, ez = c0 * wx + s0 * wy - px, c0 * wy - s0 * wx - py, point[2] - antenna[2]
    nx, ny = c0 * normal[0] + s0 * normal[1], c0 * normal[1] - s0 * normal[0]
    d = math.sqrt(ex * ex + ey * ey + ez * ez + NEAR * NEAR)
    w = 1.0 - (ex * bx + ey * by_ + ez * bz) / d
    c = -(nx * ex + ny * ey) / d
    out[0], out[1], out[2], out[3], out[4], out[5] = 1.0, -DECIBEL * math.log(d), w, w * w, c, c * c
    for i in range(3):
        # x, y: the antenna moves, the tag does not; heading: vector and normal rotate backwards
        if i == 0:
            dx, dy, dnx, dny = -1.0, 0.0, 0.0, 0.0
        elif i == 1:
            dx, dy, dnx, dny = 0.0, -1.0, 0.0, 0.0
        else:
            dx, dy, dnx, dny = ey + py, -ex - px, ny, -nx
        dd = (ex * dx + ey * dy) / d
        dw = -(dx * bx + dy * by_) / d + (1.0 - w) * dd / d
        dc = -(nx * dx + ny * dy + dnx * ex + dny * ey) / d - c * dd / d
        by[0, i], by[1, i], by[2, i], by[3, i] = 0.0, -DECIBEL * dd / d, dw, 2.0 * w * dw
        by[4, i], by[5, i] = dc, 2.0 * c * dc


@compiled
def _log_likelihood(
    antennas: Array,
    points: Array,
    normals: Array,
    b: Array,
    sigma: float,
    dof: float,
    poses: Array,
    offsets: Array,
    which: Integers,
    tags: Integers,
    rssi: Array,
    out: Array,
) -> None:
    """:func:`_score` for many poses, without derivatives."""
    heading = np.column_stack((np.cos(poses[:, 2]), np.sin(poses[:, 2])))
    for r in range(len(rssi)):
        antenna, point, normal = antennas[which[r]], points[tags[r]], normals[tags[r]]
        co, so = math.cos(offsets[r, 2]), math.sin(offsets[r, 2])
        px = offsets[r, 0] + co * antenna[0] - so * antenna[1]
        py = offsets[r, 1] + so * antenna[0] + co * antenna[1]
        bx, by = co * antenna[3] - so * antenna[4], so * antenna[3] + co * antenna[4]
        ez = point[2] - antenna[2]
        for n in range(len(poses)):
            c0, s0 = heading[n, 0], heading[n, 1]
            ex = point[0] - poses[n, 0] - c0 * px + s0 * py
            ey = point[1] - poses[n, 1] - s0 * px - c0 * py
            squared = ex * ex + ey * ey + ez * ez + NEAR * NEAR
            d = math.sqrt(squared)
            w = 1.0 - ((c0 * ex + s0 * ey) * bx + (c0 * ey - s0 * ex) * by + ez * antenna[5]) / d
            c = -(normal[0] * ex + normal[1] * ey) / d
            expected = b[0] - 0.5 * DECIBEL * b[1] * math.log(squared) + w * (b[2] + b[3] * w) + c * (b[4] + b[5] * c)
            residual = (rssi[r] - expected) / sigma
            out[n] -= 0.5 * (dof + 1.0) * math.log1p(residual * residual / dof)


@compiled
def _score(
    antennas: Array,
    points: Array,
    normals: Array,
    coefficients: Array,
    sigma: float,
    dof: float,
    poses: Array,
    offsets: Array,
    which: Integers,
    tags: Integers,
    rssi: Array,
    nll: Array,
    gradient: Array,
    information: Array,
) -> None:
    x, by = np.empty(6), np.empty((6, 3))
    slope = np.empty(3)
    weight = (dof + 1.0) / (dof + 3.0) / (sigma * sigma)
    for n in range(len(poses)):
        for r in range(len(rssi)):
            t = tags[r]
            _features(antennas[which[r]], points[t], normals[t], poses[n], offsets[r], x, by)
            residual = rssi[r] - np.dot(coefficients, x)
            squared = residual * residual / (dof * sigma * sigma)
            nll[n] += 0.5 * (dof + 1.0) * math.log1p(squared)
            pull = -(dof + 1.0) * residual / (dof * sigma * sigma * (1.0 + squared))
            for i in range(3):
                slope[i] = 0.0
                for k in range(6):
                    slope[i] += coefficients[k] * by[k, i]
            for i in range(3):
                gradient[n, i] += pull * slope[i]
                for j in range(3):
                    information[n, i, j] += weight * slope[i] * slope[j]

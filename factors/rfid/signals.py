"""Likelihoods of the phase and of the strength of RFID reads.

**Phase** refines a pose that is known to decimetres to centimetres. A reader reports ``phi = offset - 4 pi d / lambda`` (mod 2 pi)
for the distance d [m] to the tag and the wavelength lambda [m]. The offset of each antenna, tag and channel is unknown (Nikitin et
al., IEEE RFID 2010, eq. 4). Many readers add pi at random. Twice the phase removes this ambiguity: ``psi = 2 phi + 8 pi d /
lambda`` is constant over the R reads of a group, which is one antenna, tag and channel in a time window. With a von Mises density
of concentration kappa and the most likely offset, the negative log-likelihood of a group needs no phase unwrapping:

 nll = kappa (R - |S|),  S = sum exp(i psi).

Let c and s be cosine and sine of psi - arg S, and m the mean of the gradient dpsi weighted by c. The gradient is
``kappa sum s dpsi``. The Hessian, without the curvature of the distances, is ``kappa sum c (dpsi - m)(dpsi - m)^T``.
Reads with c < 0 are excluded from the Hessian, which makes it positive semi-definite.

**Strength** follows log-distance path loss with the antenna's pattern,

 rssi = a0 - 10 a1 log10(d) + a2 w + a3 w^2 + a4 c + a5 c^2  [dBm],

with the distance d [m] from the antenna to the tag, w = 1 - cosine of the angle from the boresight, and c the cosine of
the angle between the tag's facing and the direction to the antenna (0 if unknown): Rappaport, "Wireless
Communications", 2002, eq. 4.69a, with a series for the gains. Residuals have a Student density, because reflections
cause outliers (Lange, Little, Taylor, JASA 84, 1989); its Fisher information is ``(dof + 1) / (dof + 3) / sigma^2``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.compiled import compiled
from factors.rfid.detection import Score, TagArray
from factors.rfid.model import Antenna
from factors.se2 import Array, Integers

SPEED_OF_LIGHT = 299_792_458.0  # m/s
CHANNEL = 1e3  # Hz; carrier frequencies are rounded to multiples of this to number the channels
FEATURES = ("1", "-10 log10 d", "w", "w^2", "c", "c^2")
NEAR = 0.1  # m; minimum distance of the path loss
DECIBEL = 10.0 / math.log(10.0)


@dataclass(frozen=True, eq=False)
class TagReads:
    """R reads of tags, each at its own robot pose.

    ``offsets`` (R, 3): the robot's pose at each read, in the frame of a reference pose. The likelihood is a function of
    the reference pose. ``antennas`` (R,), ``tags`` (R,): indices in the model and in the map.
    """

    offsets: Array
    antennas: Integers
    tags: Integers

    def moved(self, offset: Array) -> Self:
        """Return the reads relative to a new reference pose. ``offset`` (3,): the old pose in the new pose's frame."""
        return replace(self, offsets=se2.compose(offset, self.offsets))

    def chosen(self, which: NDArray[np.bool_] | Integers) -> Self:
        """Return the reads that the mask (R,) or indices ``which`` select."""
        return type(self)(*(getattr(self, f.name)[which] for f in fields(self)))


@dataclass(frozen=True, eq=False)
class RssiReads(TagReads):
    """R reads with signal strengths ``rssi`` (R,) [dBm]."""

    rssi: Array


@dataclass(frozen=True, eq=False)
class PhaseReads(TagReads):
    """R reads with phases. ``phase`` (R,) [rad]: the reported phases. ``frequency`` (R,) [Hz]: the carrier frequencies.
    ``windows`` (R,): the number of the time window of each read. Phases are compared within a window."""

    phase: Array
    frequency: Array
    windows: Integers

    @cached_property
    def groups(self) -> Integers:
        """The group number (R,) of each read, from 0. A group is one antenna, tag and channel in a time window."""
        channel = np.rint(self.frequency / CHANNEL).astype(np.int64)
        rows = np.column_stack((self.windows, self.tags, self.antennas, channel))
        return np.asarray(np.unique(rows, axis=0, return_inverse=True)[1], dtype=np.int64).reshape(-1)

    @cached_property
    def ordered(self) -> _Ordered:
        """The reads sorted by group (antenna, tag, channel, window), as arrays for compiled code."""
        order = np.argsort(self.groups, kind="stable")
        counts = np.bincount(self.groups)
        return _Ordered(
            np.ascontiguousarray(self.offsets[order]),
            self.antennas[order],
            self.tags[order],
            2.0 * self.phase[order],
            8.0 * math.pi * self.frequency[order] / SPEED_OF_LIGHT,
            np.concatenate((np.zeros(1, np.int64), np.cumsum(counts))),
        )


class _Ordered(NamedTuple):
    """Phase reads sorted by group. ``doubled`` (R,) [rad]: twice the phase. ``wavenumber`` (R,) [rad/m]: the change of
    ``doubled`` per metre of distance. ``bounds`` (G + 1,): the indices at which the G groups begin and end."""

    offsets: Array
    antennas: Integers
    tags: Integers
    doubled: Array
    wavenumber: Array
    bounds: Integers


class PhaseProblem(NamedTuple):
    """Phase reads, map and model as arrays for compiled code. ``antennas`` (A, 6): the result of :func:`mounting`.
    ``points`` (T, 3): tag positions. ``reads``: sorted by group. ``weight``: tempering exponent times concentration."""

    antennas: Array
    points: Array
    reads: _Ordered
    weight: float


class StrengthProblem(NamedTuple):
    """Signal strengths, map and model for compiled code. ``antennas`` (A, 6): from :func:`mounting`. ``points`` (T, 3),
    ``normals`` (T, 2): the tags. ``coefficients``, ``sigma``, ``dof``: as in :class:`RssiModel`. ``weight``: the
    tempering exponent. ``offsets``, ``which``, ``tags``, ``rssi``: robot pose, antenna, tag and strength of R reads."""

    antennas: Array
    points: Array
    normals: Array
    coefficients: Array
    sigma: float
    dof: float
    weight: float
    offsets: Array
    which: Integers
    tags: Integers
    rssi: Array


@dataclass(frozen=True)
class PhaseModel:
    """The model of the phases that ``antennas`` measure. ``kappa``: concentration of the von Mises density of twice the
    phase. ``tempering``: exponent of the likelihood, below 1 for correlated reads. ``max_range`` [m]: tags beyond are
    ignored, because of reflections. ``min_reads``: least number in a group (antenna, tag, channel, window)."""

    antennas: tuple[Antenna, ...]
    kappa: float = 1.0
    tempering: float = 0.05
    max_range: float = 1.5
    min_reads: int = 3


@dataclass(frozen=True)
class RssiModel:
    """The model of signal strengths at ``antennas``, linear in :data:`FEATURES` with ``coefficients`` (6,). ``sigma``
    [dB], ``dof``: scale and degrees of freedom of the Student density of errors. ``tempering``: likelihood exponent."""

    antennas: tuple[Antenna, ...]
    coefficients: Sequence[float]
    sigma: float
    dof: float
    tempering: float = 1.0


@dataclass(frozen=True, eq=False)
class PhaseLikelihood:
    """The likelihood of phases by ``model`` as a function of the robot's pose in a map of ``tags``."""

    model: PhaseModel
    tags: TagArray

    @cached_property
    def _antennas(self) -> Array:
        return mounting(self.model.antennas)

    def near(self, pose: Array, reads: PhaseReads) -> PhaseReads:
        """Return the reads of tags within the model's ``max_range`` of a robot at ``pose`` (3,), in groups of
        ``min_reads`` or more. Call this once per window: a selection for each pose makes a likelihood discontinuous."""
        at = se2.compose(np.asarray(pose, dtype=float), reads.offsets)
        places = self._antennas[reads.antennas]
        points = self.tags.points[reads.tags]
        antennas = np.column_stack((se2.transform_from(at, places[:, :2]), places[:, 2]))
        nearby = reads.chosen(np.linalg.norm(antennas - points, axis=1) < self.model.max_range)
        return nearby.chosen(np.bincount(nearby.groups)[nearby.groups] >= self.model.min_reads)

    def problem(self, reads: PhaseReads) -> PhaseProblem:
        """Return the arrays of model, map and ``reads`` as one tuple for compiled code."""
        return PhaseProblem(self._antennas, self.tags.points, reads.ordered, self.model.tempering * self.model.kappa)

    def score(self, poses: Array, reads: PhaseReads) -> Score:
        """Return the tempered likelihood of ``reads`` at poses (N, 3), with derivatives."""
        return Score.of_signals(*phase_scores(self.problem(reads), _rows(poses), True))

    def log_likelihood(self, poses: Array, reads: PhaseReads) -> Array:
        """Return the tempered log-likelihood (N,) of ``reads`` at poses (N, 3), without derivatives, for particles."""
        return -phase_scores(self.problem(reads), _rows(poses), False)[0]


@dataclass(frozen=True, eq=False)
class RssiLikelihood:
    """The likelihood of signal strengths by ``model`` as a function of the robot's pose in a map of ``tags``. Each read
    with a residual of zero has a log-likelihood of zero."""

    model: RssiModel
    tags: TagArray

    @cached_property
    def _arrays(self) -> tuple[Array, Array, Array, Array, float, float, float]:
        m = self.model
        arrays = mounting(m.antennas), self.tags.points, self.tags.normals, np.array(m.coefficients, dtype=float)
        return *arrays, float(m.sigma), float(m.dof), float(m.tempering)

    def problem(self, reads: RssiReads) -> StrengthProblem:
        """Return the arrays of model, map and ``reads`` as one tuple for compiled code."""
        return StrengthProblem(*self._arrays, reads.offsets, reads.antennas, reads.tags, reads.rssi)

    def score(self, poses: Array, reads: RssiReads) -> Score:
        """Return the tempered likelihood of ``reads`` at poses (N, 3), with derivatives."""
        return Score.of_signals(*strength_scores(self.problem(reads), _rows(poses), True))

    def log_likelihood(self, poses: Array, reads: RssiReads) -> Array:
        """Return the tempered log-likelihood (N,) of ``reads`` at poses (N, 3), without derivatives, for particles."""
        return -strength_scores(self.problem(reads), _rows(poses), False)[0]


def _rows(poses: Array) -> Array:
    """Convert one pose (3,) or N poses to a contiguous array (N, 3) for compiled code."""
    return np.ascontiguousarray(np.atleast_2d(poses), dtype=float)


def mounting(antennas: Sequence[Antenna]) -> Array:
    """Return the positions and boresights (A, 6) of antennas in the robot frame: x, y, z and a unit vector."""
    rows = [
        (a.x, a.y, a.z, math.cos(a.yaw) * math.cos(a.pitch), math.sin(a.yaw) * math.cos(a.pitch), math.sin(a.pitch))
        for a in antennas
    ]
    return np.array(rows).reshape(-1, 6)


def features(antennas: Sequence[Antenna], tags: TagArray, pose: Array, reads: RssiReads) -> Array:
    """Return the :data:`FEATURES` (R, 6) of R reads by a robot at ``pose`` (3,), to fit :class:`RssiModel`."""
    pose, rows = np.asarray(pose, dtype=float), mounting(antennas)
    return _all_features(rows, tags.points, tags.normals, pose, reads.offsets, reads.antennas, reads.tags)


@compiled(inline="always")
def _on_robot(offset: Array, x: float, y: float) -> tuple[float, float]:
    """Transform (x, y) from the robot frame to the frame of ``offset`` (3,), the robot's pose."""
    c, s = math.cos(offset[2]), math.sin(offset[2])
    return offset[0] + c * x - s * y, offset[1] + s * x + c * y


@compiled
def phase_scores(problem: PhaseProblem, poses: Array, derivatives: bool) -> tuple[Array, Array, Array]:
    """Return the tempered negative log-likelihood (N,) of the phases of ``problem`` at poses (N, 3), its gradient (N,
    3) and its Fisher information (N, 3, 3). The last two are empty if ``derivatives`` is False."""
    antennas, points, reads, factor = problem
    count, each = len(poses) if derivatives else 0, len(reads.doubled)
    nll, gradient, information = np.zeros(len(poses)), np.zeros((count, 3)), np.zeros((count, 3, 3))
    psi, by, at = np.empty(each), np.empty((each, 3)), np.empty((each, 2))
    for r in range(each):
        antenna = antennas[reads.antennas[r]]
        at[r, 0], at[r, 1] = _on_robot(reads.offsets[r], antenna[0], antenna[1])
    for n in range(len(poses)):
        c, s = math.cos(poses[n, 2]), math.sin(poses[n, 2])
        for r in range(each):
            point = points[reads.tags[r]]
            ex = poses[n, 0] + c * at[r, 0] - s * at[r, 1] - point[0]
            ey = poses[n, 1] + s * at[r, 0] + c * at[r, 1] - point[1]
            ez = antennas[reads.antennas[r], 2] - point[2]
            distance = math.sqrt(ex * ex + ey * ey + ez * ez)
            psi[r] = reads.doubled[r] + reads.wavenumber[r] * distance
            if derivatives:
                slope = reads.wavenumber[r] / max(distance, 1e-9)
                by[r, 0], by[r, 1] = slope * (c * ex + s * ey), slope * (c * ey - s * ex)
                by[r, 2] = by[r, 1] * at[r, 0] - by[r, 0] * at[r, 1]
        for g in range(len(reads.bounds) - 1):
            begin, end = reads.bounds[g], reads.bounds[g + 1]
            real = imaginary = 0.0
            for r in range(begin, end):
                real += math.cos(psi[r])
                imaginary += math.sin(psi[r])
            nll[n] += (end - begin) - math.hypot(real, imaginary)
            if derivatives:
                offset = math.atan2(imaginary, real)
                _add_group(psi[begin:end], by[begin:end], offset, gradient[n], information[n])
    return factor * nll, factor * gradient, factor * information


@compiled
def _add_group(psi: Array, by: Array, offset: float, gradient: Array, information: Array) -> None:
    """Add the derivatives of R reads in a group, with a kappa of 1, to ``gradient`` (3,) and ``information`` (3, 3).
    ``psi`` (R,): phase errors. ``by`` (R, 3): their derivatives by the pose. ``offset``: the mean phase error."""
    total, mean = 0.0, np.zeros(3)
    for r in range(len(psi)):
        sine, weight = math.sin(psi[r] - offset), max(math.cos(psi[r] - offset), 0.0)
        total += weight
        for i in range(3):
            gradient[i] += sine * by[r, i]
            mean[i] += weight * by[r, i]
    for i in range(3):
        mean[i] /= max(total, 1e-12)
    for r in range(len(psi)):
        weight = max(math.cos(psi[r] - offset), 0.0)
        for i in range(3):
            for j in range(3):
                information[i, j] += weight * (by[r, i] - mean[i]) * (by[r, j] - mean[j])


@compiled(inline="always")
def _mounted(antenna: Array, offset: Array) -> tuple[float, float, float, float]:
    """Return an antenna's x, y and horizontal boresight (x, y) in the frame of ``offset`` (3,), the robot's pose."""
    x, y = _on_robot(offset, antenna[0], antenna[1])
    c, s = math.cos(offset[2]), math.sin(offset[2])
    return x, y, c * antenna[3] - s * antenna[4], s * antenna[3] + c * antenna[4]


@compiled(inline="always")
def _features(
    at: tuple[float, float, float, float], height: float, up: float, ex: float, ey: float, nx: float, ny: float
) -> tuple[float, float, float, float, float]:
    """Return the vector (x, y) from an antenna to a tag, their distance d, and w and c of :data:`FEATURES`.
    ``at``: from :func:`_mounted`. ``height``: height of the tag above the antenna. ``up``: vertical part of the
    boresight. (``ex``, ``ey``), (``nx``, ``ny``): position and front of the tag in the frame of the reference pose."""
    ex, ey = ex - at[0], ey - at[1]
    d = math.sqrt(ex * ex + ey * ey + height * height + NEAR * NEAR)
    return ex, ey, d, 1.0 - (ex * at[2] + ey * at[3] + height * up) / d, -(nx * ex + ny * ey) / d


@compiled
def _all_features(
    antennas: Array, points: Array, normals: Array, pose: Array, offsets: Array, which: Integers, tags: Integers
) -> Array:
    """Return the result of :func:`features`, computed in compiled code."""
    out, c0, s0 = np.empty((len(tags), 6)), math.cos(pose[2]), math.sin(pose[2])
    for r in range(len(tags)):
        antenna, point, normal = antennas[which[r]], points[tags[r]], normals[tags[r]]
        x, y = point[0] - pose[0], point[1] - pose[1]
        nx, ny = c0 * normal[0] + s0 * normal[1], c0 * normal[1] - s0 * normal[0]
        at, height = _mounted(antenna, offsets[r]), point[2] - antenna[2]
        _, _, d, w, c = _features(at, height, antenna[5], c0 * x + s0 * y, c0 * y - s0 * x, nx, ny)
        out[r, 0], out[r, 1], out[r, 2], out[r, 3], out[r, 4], out[r, 5] = (
            1.0,
            -DECIBEL * math.log(d),
            w,
            w * w,
            c,
            c * c,
        )
    return out


@compiled
def strength_scores(problem: StrengthProblem, poses: Array, derivatives: bool) -> tuple[Array, Array, Array]:
    """Return the tempered negative log-likelihood (N,) of signal strengths of ``problem`` at poses (N, 3), its gradient
    (N, 3) and its Fisher information (N, 3, 3). The last two are empty if ``derivatives`` is False."""
    antennas, points, normals, b, sigma, dof, factor, offsets, which, tags, rssi = problem
    count = len(poses) if derivatives else 0
    nll, gradient, information = np.zeros(len(poses)), np.zeros((count, 3)), np.zeros((count, 3, 3))
    heading, by = np.column_stack((np.cos(poses[:, 2]), np.sin(poses[:, 2]))), np.empty(3)
    weight, variance = (dof + 1.0) / (dof + 3.0) / (sigma * sigma), dof * sigma * sigma
    for r in range(len(rssi)):
        antenna, point, normal = antennas[which[r]], points[tags[r]], normals[tags[r]]
        at, height = _mounted(antenna, offsets[r]), point[2] - antenna[2]
        for n in range(len(poses)):
            c0, s0 = heading[n, 0], heading[n, 1]
            x, y = point[0] - poses[n, 0], point[1] - poses[n, 1]
            nx, ny = c0 * normal[0] + s0 * normal[1], c0 * normal[1] - s0 * normal[0]
            ex, ey, d, w, c = _features(at, height, antenna[5], c0 * x + s0 * y, c0 * y - s0 * x, nx, ny)
            expected = b[0] - DECIBEL * b[1] * math.log(d) + w * (b[2] + b[3] * w) + c * (b[4] + b[5] * c)
            residual = rssi[r] - expected
            squared = residual * residual / variance
            nll[n] += 0.5 * (dof + 1.0) * math.log1p(squared)
            if not derivatives:
                continue
            for i in range(3):
                # a motion of the robot moves the vector to the tag, and the tag's facing, in the opposite direction
                dx, dy, dnx, dny = -1.0 if i == 0 else 0.0, -1.0 if i == 1 else 0.0, 0.0, 0.0
                if i == 2:
                    dx, dy, dnx, dny = ey + at[1], -ex - at[0], ny, -nx
                dd = (ex * dx + ey * dy) / d
                dw = -(dx * at[2] + dy * at[3]) / d + (1.0 - w) * dd / d
                dc = -(nx * dx + ny * dy + dnx * ex + dny * ey) / d - c * dd / d
                by[i] = -DECIBEL * b[1] * dd / d + (b[2] + 2.0 * b[3] * w) * dw + (b[4] + 2.0 * b[5] * c) * dc
            for i in range(3):
                gradient[n, i] -= (dof + 1.0) * residual / (variance * (1.0 + squared)) * by[i]
                for j in range(3):
                    information[n, i, j] += weight * by[i] * by[j]
    return factor * nll, factor * gradient, factor * information

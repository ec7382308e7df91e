"""The likelihood of the phase of RFID reads, which refines a pose known to decimetres to centimetres.

A reader reports ``phi = offset - 4 pi d / lambda`` (mod 2 pi) for the distance d [m] to the tag, with an unknown offset of each
antenna, tag and channel (Nikitin et al., IEEE RFID 2010, eq. 4). Many readers add pi at random, to which twice the phase is
invariant: ``psi = 2 phi + 8 pi d / lambda`` is constant over the R reads of a group (one antenna, tag and channel in a window).
With a von Mises density of concentration kappa and the most likely offset, the negative log-likelihood of a group is

 nll = kappa (R - |S|),  S = sum exp(i psi),

without phase unwrapping. With c and s, cosine and sine of psi - arg S, its gradient is ``kappa sum s dpsi``, and its Hessian,
neglecting the curvature of the distances, ``kappa sum c (dpsi - m)(dpsi - m)^T`` with m the mean of dpsi weighted by c. Reads with
c < 0 are excluded from it, which makes it positive semi-definite.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.compiled import compiled
from factors.rfid.detection import TagArray
from factors.rfid.model import Antenna
from factors.se2 import Array

Integers = NDArray[np.int64]
SPEED_OF_LIGHT = 299_792_458.0  # m/s
CHANNEL = 1e3  # Hz; carriers closer than that are one channel


@dataclass(frozen=True, eq=False)
class PhaseReads:
    """R reads of one or several windows, each at its own pose.

    ``offsets`` (R, 3): the robot's pose at the read, in the frame of the likelihood's pose; ``antennas`` (R,) and ``tags`` (R,):
    indices in the model and in the map; ``phase`` (R,) [rad] as reported, ``frequency`` (R,) [Hz] of the carrier; ``windows`` (R,):
    window numbers, if there are several.
    """

    offsets: Array
    antennas: Integers
    tags: Integers
    phase: Array
    frequency: Array
    windows: Integers

    def moved(self, offset: Array) -> PhaseReads:
        """The reads relative to the pose that lies ``offset`` (3,) before theirs."""
        return replace(self, offsets=se2.compose(offset, self.offsets))

    def chosen(self, which: NDArray[np.bool_] | Integers) -> PhaseReads:
        """The selected reads."""
        return PhaseReads(*(getattr(self, f.name)[which] for f in fields(self)))

    @cached_property
    def groups(self) -> Integers:
        """The group of each read (R,), numbered from 0."""
        channel = np.rint(self.frequency / CHANNEL).astype(np.int64)
        rows = np.column_stack((self.windows, self.tags, self.antennas, channel))
        return np.asarray(np.unique(rows, axis=0, return_inverse=True)[1], dtype=np.int64).reshape(-1)

    @cached_property
    def ordered(self) -> _Ordered:
        """The reads sorted by group, for compiled code."""
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
    """``doubled`` (R,) [rad]: twice the phase; ``wavenumber`` (R,) [rad/m]: of that; ``bounds`` (G + 1,): of the groups."""

    offsets: Array
    antennas: Integers
    tags: Integers
    doubled: Array
    wavenumber: Array
    bounds: Integers


@dataclass(frozen=True)
class PhaseModel:
    """``antennas``: their mounting; ``kappa``: concentration of twice the phase; ``tempering``: exponent of the likelihood, for
    correlated reads and windows; ``max_range`` [m]: limit because of reflections; ``min_reads``: minimum per group."""

    antennas: tuple[Antenna, ...]
    kappa: float = 1.0
    tempering: float = 0.05
    max_range: float = 1.5
    min_reads: int = 3


class PhaseScore(NamedTuple):
    """Tempered likelihoods of N poses. ``nll`` (N,); ``gradient`` (N, 3), ``information`` (N, 3, 3) by body-frame perturbation."""

    nll: Array
    gradient: Array
    information: Array


@dataclass(frozen=True, eq=False)
class PhaseLikelihood:
    """The likelihood of a phase model with a map of tags."""

    model: PhaseModel
    tags: TagArray
    _antennas: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        places = np.array([(a.x, a.y, a.z) for a in self.model.antennas]).reshape(-1, 3)
        object.__setattr__(self, "_antennas", places)

    def near(self, pose: Array, reads: PhaseReads) -> PhaseReads:
        """The reads within the model's range of a pose (3,), in groups with enough of them.

        Call this once per window with the best known pose: a selection that depends on the pose makes the likelihood discontinuous.
        """
        at = se2.compose(np.asarray(pose, dtype=float), reads.offsets)
        places = self._antennas[reads.antennas]
        points = self.tags.points[reads.tags]
        antennas = np.column_stack((se2.transform_from(at, places[:, :2]), places[:, 2]))
        found = reads.chosen(np.linalg.norm(antennas - points, axis=1) < self.model.max_range)
        return found.chosen(np.bincount(found.groups)[found.groups] >= self.model.min_reads)

    def score(self, poses: Array, reads: PhaseReads) -> PhaseScore:
        """Likelihood, gradient and information at poses (N, 3)."""
        poses = np.ascontiguousarray(np.atleast_2d(poses), dtype=float)
        n = len(poses)
        out = PhaseScore(np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3, 3)))
        _score(self._antennas, self.tags.points, poses, *reads.ordered, *out)
        return PhaseScore(*(self.model.tempering * self.model.kappa * part for part in out))

    def log_likelihood(self, poses: Array, reads: PhaseReads) -> Array:
        """Tempered log-likelihood (N,) at poses (N, 3), for particles."""
        out = np.zeros(len(poses))
        poses = np.ascontiguousarray(poses, dtype=float)
        _log_likelihood(self._antennas, self.tags.points, poses, *reads.ordered, out)
        return self.model.tempering * self.model.kappa * out


@compiled
def _log_likelihood(
    places: Array,
    points: Array,
    poses: Array,
    offsets: Array,
    antennas: Integers,
    tags: Integers,
    doubled: Array,
    wavenumber: Array,
    bounds: Integers,
    out: Array,
) -> None:
    reads = len(doubled)
    x, y = np.empty(reads), np.empty(reads)
    for r in range(reads):
        x[r], y[r] = _on_robot(offsets[r], places[antennas[r]])
    for n in range(len(poses)):
        c, s = math.cos(poses[n, 2]), math.sin(poses[n, 2])
        for g in range(len(bounds) - 1):
            real = imaginary = 0.0
            for r in range(bounds[g], bounds[g + 1]):
                ex = poses[n, 0] + c * x[r] - s * y[r] - points[tags[r], 0]
                ey = poses[n, 1] + s * x[r] + c * y[r] - points[tags[r], 1]
                ez = places[antennas[r], 2] - points[tags[r], 2]
                psi = doubled[r] + wavenumber[r] * math.sqrt(ex * ex + ey * ey + ez * ez)
                real += math.cos(psi)
                imaginary += math.sin(psi)
            out[n] += math.hypot(real, imaginary) - (bounds[g + 1] - bounds[g])


@compiled
def _on_robot(offset: Array, place: Array) -> tuple[float, float]:
    """Position of an antenna in the frame of the likelihood's pose."""
    c, s = math.cos(offset[2]), math.sin(offset[2])
    return offset[0] + c * place[0] - s * place[1], offset[1] + s * place[0] + c * place[1]


@compiled
def _score(
    places: Array,
    points: Array,
    poses: Array,
    offsets: Array,
    antennas: Integers,
    tags: Integers,
    doubled: Array,
    wavenumber: Array,
    bounds: Integers,
    nll: Array,
    gradient: Array,
    information: Array,
) -> None:
    psi = np.empty(len(doubled))
    by = np.empty((len(doubled), 3))
    for n in range(len(poses)):
        c, s = math.cos(poses[n, 2]), math.sin(poses[n, 2])
        for r in range(len(doubled)):
            x, y = _on_robot(offsets[r], places[antennas[r]])
            ex = poses[n, 0] + c * x - s * y - points[tags[r], 0]
            ey = poses[n, 1] + s * x + c * y - points[tags[r], 1]
            ez = places[antennas[r], 2] - points[tags[r], 2]
            distance = math.sqrt(ex * ex + ey * ey + ez * ez)
            psi[r] = doubled[r] + wavenumber[r] * distance
            slope = wavenumber[r] / max(distance, 1e-9)
            by[r, 0] = slope * (c * ex + s * ey)
            by[r, 1] = slope * (c * ey - s * ex)
            by[r, 2] = by[r, 1] * x - by[r, 0] * y
        for g in range(len(bounds) - 1):
            nll[n] += _add_group(psi, by, bounds[g], bounds[g + 1], gradient[n], information[n])


@compiled
def _add_group(psi: Array, by: Array, begin: int, end: int, gradient: Array, information: Array) -> float:
    """Add gradient (3,) and information (3, 3) of a group, for kappa 1; returns its negative log-likelihood."""
    real = imaginary = 0.0
    for r in range(begin, end):
        real += math.cos(psi[r])
        imaginary += math.sin(psi[r])
    offset = math.atan2(imaginary, real)
    total = 0.0
    mean = np.zeros(3)
    for r in range(begin, end):
        sine, weight = math.sin(psi[r] - offset), max(math.cos(psi[r] - offset), 0.0)
        total += weight
        for i in range(3):
            gradient[i] += sine * by[r, i]
            mean[i] += weight * by[r, i]
    for i in range(3):
        mean[i] /= max(total, 1e-12)
    for r in range(begin, end):
        weight = max(math.cos(psi[r] - offset), 0.0)
        for i in range(3):
            for j in range(3):
                information[i, j] += weight * (by[r, i] - mean[i]) * (by[r, j] - mean[j])
    return (end - begin) - math.hypot(real, imaginary)

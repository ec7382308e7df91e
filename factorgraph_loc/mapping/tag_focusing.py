"""Positions of tags with centimetre accuracy, from the phases of reads at known robot poses.

Phases of one tag, antenna and channel within a short time window are compared with the phases predicted for a tag
position (:mod:`factors.rfid.signals`). The differences are equal only at the true position of the tag, as in a
synthetic aperture (holography: Miesen, Kirsch, Vossiek, IEEE RFID 2011). Unknown phase offsets and frequency hopping
cancel within a window. Therefore only the relative poses within a window must be accurate to a fraction of the
wavelength. The prior is the position estimated from reads and misses. The likelihood has side lobes. Therefore it is
evaluated on a lattice first, and the best position is refined by Fisher scoring.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from factorgraph_loc.mapping.tag_slam import TagObservations
from factorgraph_loc.model.belief import LearntPoint
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.rfid.settings import RfidSettings
from factorgraph_loc.sensors.rfid.stream import phase_reads
from factors.least_squares import minimum
from factors.rfid.detection import TagArray
from factors.rfid.signals import PhaseLikelihood, PhaseModel, PhaseReads
from factors.se2 import Array

# exponent of the likelihood. The exponent of localization is smaller, to account for errors of the given tag positions.
TEMPERING = 0.5
STEP = 0.02  # m: spacing of the lattice, a quarter of the period of the likelihood
REACH, FARTHEST = 3.0, 1.0  # half the size of the lattice: standard deviations of the prior, and upper bound in m
SELECTIONS = 3  # number of times that the used reads are selected, because the selection depends on the position
ITERATIONS, CONVERGED = 20, 1e-4  # of Fisher scoring; the step is in m
FEWEST = 20  # reads
INTERPOLATED, LONGEST = 0.05, 2.0  # s between interpolated poses, and largest time between keyframes


def focused(
    log: Log, observations: TagObservations, learnt: Mapping[int, LearntPoint], keyframes: Trajectory | None = None
) -> dict[int, LearntPoint]:
    """Return positions of tags, by index of the tag, improved by the signal phases of their reads.

    ``observations``: supplies the names and heights of the tags. ``learnt``: the initial positions, by index of the
    tag. ``keyframes``: the estimated trajectory of the robot. If it is None, the log's reference is used. A position
    does not change if the height of the tag is unknown, or if too few reads have a phase. No position changes if the
    rig has no section ``[rfid.phase]``.
    """
    rfid = log.rig.of(RfidSettings)
    if rfid.phase is None:
        return dict(learnt)
    if keyframes is not None:
        t = np.arange(keyframes.t[0], keyframes.t[-1], INTERPOLATED)
        poses = keyframes.at(t, max_gap=LONGEST)
        known = np.isfinite(poses[:, 0])
        log = replace(log, reference=Trajectory(t[known], poses[known]))
    model = replace(rfid.phase.model(rfid.model().antennas), tempering=TEMPERING)
    antennas = {name: i for i, name in enumerate(rfid.all_antennas())}
    wanted = {name: i for i, name in enumerate(observations.names) if i in learnt and observations.has_height[i]}
    reads = phase_reads(log, wanted, antennas, rfid.phase.window)
    out = dict(learnt)
    for tag in wanted.values():
        mine = reads.chosen(reads.tags == tag)
        alone = replace(mine, tags=np.zeros_like(mine.tags))
        out[tag] = _focused(model, alone, float(observations.heights[tag]), learnt[tag])
    return out


def _focused(model: PhaseModel, reads: PhaseReads, height: float, prior: LearntPoint) -> LearntPoint:
    """Return an improved position of one tag at ``height`` [m]. ``prior``: its initial position with covariance.
    ``reads``: the reads of this tag with phase, and the antenna poses in the world frame."""
    information = np.asarray(np.linalg.inv(prior.covariance), dtype=np.float64)
    position = prior
    for _ in range(SELECTIONS):
        tag = TagArray(np.array([(*position.position, height)]), np.full(1, np.nan))
        likelihood = PhaseLikelihood(model, tag)
        near = likelihood.near(np.zeros(3), reads)
        if len(near.tags) < FEWEST:
            break
        start = position.position - prior.position
        off = _best(likelihood, near, start, information, _lattice(prior.covariance) - start)
        off, curvature = _refined(likelihood, near, start, information, off)
        position = LearntPoint(position.position + off, np.asarray(np.linalg.inv(curvature), dtype=np.float64))
    return position


def _lattice(covariance: Array) -> Array:
    """Return a lattice of displacements (G, 2) [m] within ``REACH`` standard deviations of zero. The first is zero.
    ``covariance`` (2, 2) [m^2]: of the position."""
    extent = np.minimum(REACH * np.sqrt(np.diag(covariance)), FARTHEST)
    axes = [np.arange(-e, e + STEP, STEP) for e in extent]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    inside = np.einsum("gi,ij,gj->g", cells, np.linalg.inv(covariance), cells) <= REACH**2
    return np.vstack((np.zeros((1, 2)), cells[inside]))


def _best(likelihood: PhaseLikelihood, reads: PhaseReads, start: Array, information: Array, offs: Array) -> Array:
    """Return the displacement (2,) of a tag, among ``offs`` (G, 2), that has the largest posterior density.
    ``likelihood``: that of the phases of ``reads`` for a tag at ``start``. ``start`` (2,): the position before the
    displacement, relative to the mean of the prior. ``information`` (2, 2): the inverse covariance of the prior."""
    poses = np.column_stack((-offs, np.zeros(len(offs))))
    moved = offs + start
    cost = 0.5 * np.einsum("gi,ij,gj->g", moved, information, moved) - likelihood.log_likelihood(poses, reads)
    return np.asarray(offs[int(np.argmin(cost))])


def _refined(
    likelihood: PhaseLikelihood, reads: PhaseReads, start: Array, information: Array, off: Array
) -> tuple[Array, Array]:
    """Return the displacement (2,) of a tag with the largest posterior density, and its information matrix (2, 2).
    Fisher scoring starts at the displacement ``off`` (2,). ``start`` (2,): the position before the displacement,
    relative to the mean of the prior. ``information`` (2, 2): the inverse covariance of the prior."""

    def at(off: Array) -> tuple[float, Array, Array]:
        score, moved = likelihood.score(np.array((*-off, 0.0)), reads), off + start
        gradient = information @ moved - score.gradient[0, :2]
        cost = float(score.nll[0] + 0.5 * moved @ information @ moved)
        return cost, gradient, score.information[0, :2, :2] + information

    optimum, _, curvature = minimum(at, off, ITERATIONS, CONVERGED, largest=STEP)
    return optimum, curvature

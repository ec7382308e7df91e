"""Positions of tags to centimetres, from the phases of reads along known poses.

The phase of the path is subtracted from the phases of one tag, antenna and channel within a window (:mod:`factors.rfid.signals`).
The results agree only at the tag's position, as in a synthetic aperture (holography: Miesen, Kirsch, Vossiek, IEEE RFID 2011).
Unknown phase offsets and frequency hopping cancel within a window. Therefore only the relative poses of one window must be exact
to a fraction of the wavelength. The prior is the position from reads and misses. The likelihood has side lobes: it is evaluated on
a lattice first, then refined by Fisher scoring.
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

# Exponent of the likelihood. That of the rig, for localization, is smaller, as it also allows for errors of the surveyed tags.
TEMPERING = 0.5
STEP = 0.02  # m, of the lattice: a quarter of the period of twice the phase
REACH, FARTHEST = 3.0, 1.0  # standard deviations of the prior, and m, that are searched
SELECTIONS = 3  # the reads used depend on the position that they improve
ITERATIONS, CONVERGED = 20, 1e-4  # m
FEWEST = 20  # reads
INTERPOLATED, LONGEST = 0.05, 2.0  # s between interpolated poses, and at most between keyframes


def focused(
    log: Log, observations: TagObservations, learnt: Mapping[int, LearntPoint], keyframes: Trajectory | None = None
) -> dict[int, LearntPoint]:
    """The ``learnt`` positions by tag, improved by the phases of the reads along the log's reference, or along the estimated
    ``keyframes``, which are interpolated.

    Positions of tags with unknown height, or with too few reads with a phase, do not change; none does if the rig has no
    ``[rfid.phase]``.
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
    """The position of the only tag of ``reads``, which are relative to the world's origin."""
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
    """Displacements (G, 2) within ``REACH`` standard deviations of zero."""
    extent = np.minimum(REACH * np.sqrt(np.diag(covariance)), FARTHEST)
    axes = [np.arange(-e, e + STEP, STEP) for e in extent]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    inside = np.einsum("gi,ij,gj->g", cells, np.linalg.inv(covariance), cells) <= REACH**2
    return np.vstack((np.zeros((1, 2)), cells[inside]))


def _best(likelihood: PhaseLikelihood, reads: PhaseReads, start: Array, information: Array, offs: Array) -> Array:
    """The best displacement of ``offs`` (G, 2) from ``start``. Displacing the tag is displacing all poses the other way."""
    poses = np.column_stack((-offs, np.zeros(len(offs))))
    moved = offs + start
    cost = 0.5 * np.einsum("gi,ij,gj->g", moved, information, moved) - likelihood.log_likelihood(poses, reads)
    return np.asarray(offs[int(np.argmin(cost))])


def _refined(
    likelihood: PhaseLikelihood, reads: PhaseReads, start: Array, information: Array, off: Array
) -> tuple[Array, Array]:
    """The displacement (2,) at the nearest optimum, and the information (2, 2) there."""

    def at(off: Array) -> tuple[float, Array, Array]:
        score, moved = likelihood.score(np.array((*-off, 0.0)), reads), off + start
        gradient = information @ moved - score.gradient[0, :2]
        cost = float(score.nll[0] + 0.5 * moved @ information @ moved)
        return cost, gradient, score.information[0, :2, :2] + information

    optimum, _, curvature = minimum(at, off, ITERATIONS, CONVERGED, largest=STEP)
    return optimum, curvature

"""Fits signals of reads to logs with a reference: the model of signal strength, and the geometry from phases.

Phases determine the survey's transform, and a shift that all antennas have in common (lever arm), as in synthetic
aperture radar. With the correct geometry the phases of one tag's reads within a short window agree, after the phase of
the path is subtracted (:mod:`factors.rfid.signals`). The estimate maximises this agreement over a log. A coarse grid
search finds the maximum, because it is wide: errors that are common to a window reduce the agreement only slowly.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import scipy
from scipy.optimize import minimize_scalar
from scipy.special import gammaln

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.settings import RfidSettings, RssiSettings, SurveySettings
from factorgraph_loc.sensors.rfid.stream import along_reference, phase_reads
from factorgraph_loc.text import listed
from factors import se2
from factors.rfid.detection import TagArray
from factors.rfid.signals import FEATURES, PhaseLikelihood, PhaseModel, PhaseReads, RssiReads, features
from factors.se2 import Array

ENOUGH_READS = 1000  # minimum number of reads with a phase
SHIFTS = (-0.3, -0.15, 0.0, 0.15, 0.3)  # m; shifts of the survey in the coarse search
HEADINGS = (-0.05, -0.025, 0.0, 0.025, 0.05)  # rad; rotations of the survey in the coarse search
THINNING = 6  # the coarse search uses one window in six
BLOCKS = 8  # number of time blocks for the jackknife


@dataclass(frozen=True)
class PhaseFit:
    """The survey transform and the mounting of antennas, estimated from phases.

    ``survey``: the survey transform. ``lever_arm`` (2,): a correction of x and y [m] of all antennas. ``sigmas`` (5,):
    standard deviations of x, y [m] and heading [rad] of the transform, and of x, y [m] of the lever arm.
    ``initial_agreement``, ``agreement``: the mean resultant length (0 to 1) of the phases before and after the fit.
    ``reads``: the number of reads used.
    """

    survey: SurveySettings
    lever_arm: tuple[float, float]
    sigmas: Array
    initial_agreement: float
    agreement: float
    reads: int


def fit_phase(logs: Sequence[Log], rfid: RfidSettings, survey: SurveySettings | None = None) -> PhaseFit:
    """Return the survey transform and the correction of antenna positions that maximise the agreement of phases.

    All ``logs`` must have the same world. ``rfid``: the mounting of antennas. ``survey``: the initial survey transform.
    Standard deviations are estimated by a jackknife over time blocks. Raises InputError if a log has no reference, or
    if too few phases are near their tags.
    """
    start = survey or SurveySettings()
    focus = _Focus.of(logs, rfid, start)
    origin = np.array((start.x, start.y, start.heading, 0.0, 0.0))
    coarse = focus.near(origin)
    if coarse.count < ENOUGH_READS:
        names = listed(log.name for log in logs)
        expected = f"expected at least {ENOUGH_READS} within {focus.model.max_range:g} m of their tags"
        raise InputError(f"{names}: {coarse.count} reads have a phase, {expected}")
    # select the reads near their tags again, with the survey transform of the coarse search
    fine = focus.near(coarse.climb(coarse.coarse(origin)))
    state = fine.climb(coarse.coarse(origin))
    parts = np.array([fine.without(block).climb(state) for block in range(BLOCKS)])
    sigmas = np.sqrt((BLOCKS - 1) / BLOCKS * np.sum((parts - parts.mean(axis=0)) ** 2, axis=0))
    lever_arm = (float(state[3]), float(state[4]))
    return PhaseFit(fine.survey(state), lever_arm, sigmas, fine.agreement(origin), fine.agreement(state), fine.count)


@dataclass(frozen=True)
class _Focus:
    """The agreement of phases along references as a function of a state (5,): their mean resultant length, 0 to 1.

    The state is x, y, heading of the survey transform, and a correction of x, y of all antennas. ``reads``: the reads
    with a phase. ``model``: the model of phases. ``tags``: the tags in the survey frame. ``initial``: the initial
    transform.
    """

    reads: PhaseReads
    model: PhaseModel
    tags: TagArray
    initial: SurveySettings

    @classmethod
    def of(cls, logs: Sequence[Log], rfid: RfidSettings, survey: SurveySettings) -> _Focus:
        tags = tag_map(logs[0].world, SurveySettings())
        names = {name: i for i, name in enumerate(rfid.all_antennas())}
        parts: list[PhaseReads] = []
        first_window = 0
        for log in logs:
            parts.append(phase_reads(log, tags.index, names, first_window=first_window))
            first_window = 1 + int(parts[-1].windows.max(initial=first_window))
        reads = PhaseReads(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(PhaseReads)))
        model = PhaseModel(rfid.model().antennas, kappa=1.0, tempering=1.0)
        return cls(reads, model, tags.tags, survey)

    @property
    def count(self) -> int:
        return len(self.reads.tags)

    def survey(self, state: Array) -> SurveySettings:
        return self.initial.model_copy(update=dict(zip(("x", "y", "heading"), state[:3].tolist(), strict=True)))

    def near(self, state: Array) -> _Focus:
        """Return a copy with only the reads near their tags at ``state`` (5,), in windows with enough such reads."""
        return replace(self, reads=self._likelihood(state).near(self._pose(state), self.reads))

    def without(self, block: int) -> _Focus:
        """Return a copy without the reads of the time block with index ``block``. The jackknife uses it."""
        edges = np.linspace(0, int(self.reads.windows.max()) + 1, BLOCKS + 1)
        inside = (self.reads.windows >= edges[block]) & (self.reads.windows < edges[block + 1])
        return replace(self, reads=self.reads.chosen(~inside))

    def agreement(self, state: Array) -> float:
        """Return the agreement of the phases at ``state`` (5,), as mean resultant length (0 to 1)."""
        return 1.0 + float(self._likelihood(state).log_likelihood(self._pose(state)[None], self.reads)[0]) / self.count

    def coarse(self, origin: Array) -> Array:
        """Return the state (5,) of maximum agreement on a grid of survey transforms around ``origin`` (5,). Only some
        time windows of phases are used, to save time."""
        some = replace(self, reads=self.reads.chosen(self.reads.windows % THINNING == 0))
        states = [origin + np.array((x, y, h, 0.0, 0.0)) for x, y, h in itertools.product(SHIFTS, SHIFTS, HEADINGS)]
        return max(states, key=some.agreement)

    def climb(self, state: Array) -> Array:
        """Return the local maximum (5,) of the agreement that is found by an optimizer from ``state`` (5,)."""
        # a heading of 0.3 rad has about the same effect as a shift of 1 m
        unit = np.array((1.0, 1.0, 0.3, 1.0, 1.0))
        result = scipy.optimize.minimize(
            lambda v: -self.agreement(v * unit), state / unit, options={"eps": 1e-5, "gtol": 1e-4}
        )
        return np.asarray(result.x * unit)

    def _pose(self, state: Array) -> Array:
        """Return the pose (3,) of the world frame in the survey frame, at ``state`` (5,)."""
        return se2.inverse(self.survey(state).transform())

    def _likelihood(self, state: Array) -> PhaseLikelihood:
        x, y = map(float, state[3:])
        antennas = tuple(replace(a, x=a.x + x, y=a.y + y) for a in self.model.antennas)
        return PhaseLikelihood(replace(self.model, antennas=antennas), self.tags)


ENOUGH_STRENGTHS = 200  # minimum number of reads with a signal strength
ITERATIONS = 30  # number of iterations of the fit to signal strengths
DOF = (1.0, 100.0)  # bounds of the degrees of freedom of the noise


def fit_rssi(logs: Sequence[Log], rfid: RfidSettings, survey: SurveySettings) -> RssiSettings:
    """Return the maximum likelihood model of signal strength (:mod:`factors.rfid.signals`) for all ``logs``.

    ``rfid``: the mounting of antennas. ``survey``: the transform of the tags to the world frame. Limitation: the fitted
    path loss is smaller than in free space, because signals below the sensitivity of the reader are missing. Raises
    InputError if a log has no reference, or if too few reads have an RSSI.
    """
    names = {name: i for i, name in enumerate(rfid.all_antennas())}
    tables, values = list[Array](), list[Array]()
    for log in logs:
        tags = tag_map(log.world, survey)
        stream, rows, _, poses, antenna, tag = along_reference(log, tags.index, names)
        good = np.isfinite(stream.rssi[rows])
        reads = RssiReads(poses[good], antenna[good], tag[good], stream.rssi[rows][good])
        tables.append(features(rfid.model().antennas, tags.tags, np.zeros(3), reads))
        values.append(reads.rssi)
    if (count := sum(map(len, values))) < ENOUGH_STRENGTHS:
        raise InputError(
            f"{listed(log.name for log in logs)}: {count} reads have an RSSI, expected at least {ENOUGH_STRENGTHS}"
        )
    coefficients, sigma, dof = _student(np.concatenate(tables).reshape(-1, len(FEATURES)), np.concatenate(values))
    return RssiSettings.bounded(coefficients=tuple(coefficients.tolist()), sigma=sigma, dof=dof)


def _student(x: Array, y: Array) -> tuple[Array, float, float]:
    """Return the coefficients (F,) of a linear model with Student-t noise, and the scale and degrees of freedom of the
    noise. The model predicts ``y`` (N,) from features ``x`` (N, F). Source: Liu, Rubin, Statistica Sinica 5, 1995."""
    dof, weights = 5.0, np.ones(len(y))
    for _ in range(ITERATIONS):
        root = np.sqrt(weights)
        coefficients: Array = np.linalg.lstsq(x * root[:, None], y * root, rcond=None)[0].astype(float)
        residuals = y - x @ coefficients
        sigma = math.sqrt(np.mean(weights * residuals**2))

        def cost(v: float, ratios: Array = residuals / sigma) -> float:
            """Return the mean negative log density of a Student-t distribution with exp(v) degrees of freedom."""
            dof = math.exp(v)
            scale = gammaln(dof / 2.0) - gammaln((dof + 1.0) / 2.0) + 0.5 * math.log(dof * math.pi)
            return float(scale + 0.5 * (dof + 1.0) * np.mean(np.log1p(ratios**2 / dof)))

        dof = math.exp(minimize_scalar(cost, bounds=np.log(DOF), method="bounded").x)
        weights = (dof + 1.0) / (dof + (residuals / sigma) ** 2)
    return coefficients, sigma, dof

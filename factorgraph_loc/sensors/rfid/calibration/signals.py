"""Fits of the signals of reads to logs with a reference: of the strength's model, and of the geometry by focusing the phases.

Along a reference trajectory the phases of one tag's reads within a short window agree after subtracting the phase of the path
(:mod:`factors.rfid.signals`), if the geometry is right. Their agreement over a log determines the survey's transform and the common
lever arm of the antennas, as in synthetic aperture radar. The peak is wide enough for a coarse grid search, because errors common
to a window defocus slowly.
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

ENOUGH_READS = 1000
SHIFTS = (-0.3, -0.15, 0.0, 0.15, 0.3)  # m; coarse search
HEADINGS = (-0.05, -0.025, 0.0, 0.025, 0.05)  # rad
THINNING = 6  # of the windows, in the coarse search
BLOCKS = 8  # of windows; one is left out in each part of the jackknife


@dataclass(frozen=True)
class PhaseFit:
    """``survey``: transform of the survey; ``lever_arm`` (2,): correction of x and y [m] of every antenna; ``sigmas`` (5,):
    standard deviations of the survey's x, y [m] and heading [rad] and of the lever arm's x, y [m]; ``agreement`` of the phases as
    mean resultant length (0 to 1), and with the initial values; ``reads``: number of reads used.

    The gain in untempered log-likelihood per read is kappa times the growth of the agreement.
    """

    survey: SurveySettings
    lever_arm: tuple[float, float]
    sigmas: Array
    initial_agreement: float
    agreement: float
    reads: int


def fit_phase(logs: Sequence[Log], rfid: RfidSettings, survey: SurveySettings | None = None) -> PhaseFit:
    """Estimate survey and lever arm by focusing the phases of all ``logs``, in one world; ``survey``: initial value.

    Standard deviations are those of the jackknife over blocks of time, which is robust to correlated reads. InputError if a log
    has no reference, or there are too few reads with a phase near their tags.
    """
    start = survey or SurveySettings()
    focus = _Focus.of(logs, rfid, start)
    origin = np.array((start.x, start.y, start.heading, 0.0, 0.0))
    coarse = focus.near(origin)
    if coarse.count < ENOUGH_READS:
        names = listed(log.name for log in logs)
        expected = f"expected at least {ENOUGH_READS} within {focus.model.max_range:g} m of their tags"
        raise InputError(f"{names}: hold {coarse.count} reads with a phase, {expected}")
    # select again, because other reads are near their tags after the coarse search
    fine = focus.near(coarse.climb(coarse.coarse(origin)))
    state = fine.climb(coarse.coarse(origin))
    parts = np.array([fine.without(block).climb(state) for block in range(BLOCKS)])
    sigmas = np.sqrt((BLOCKS - 1) / BLOCKS * np.sum((parts - parts.mean(axis=0)) ** 2, axis=0))
    lever_arm = (float(state[3]), float(state[4]))
    return PhaseFit(fine.survey(state), lever_arm, sigmas, fine.agreement(origin), fine.agreement(state), fine.count)


@dataclass(frozen=True)
class _Focus:
    """Reads along references, centred at the origin. States (5,): x, y, heading of the survey, lever arm x, y."""

    reads: PhaseReads
    model: PhaseModel
    tags: TagArray  # as surveyed
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
        """The reads that are near their tags, in windows with enough of them."""
        return replace(self, reads=self._likelihood(state).near(self._pose(state), self.reads))

    def without(self, block: int) -> _Focus:
        """All but one block of windows."""
        edges = np.linspace(0, int(self.reads.windows.max()) + 1, BLOCKS + 1)
        inside = (self.reads.windows >= edges[block]) & (self.reads.windows < edges[block + 1])
        return replace(self, reads=self.reads.chosen(~inside))

    def agreement(self, state: Array) -> float:
        """Mean resultant length of the phases (0 to 1)."""
        return 1.0 + float(self._likelihood(state).log_likelihood(self._pose(state)[None], self.reads)[0]) / self.count

    def coarse(self, origin: Array) -> Array:
        """The best survey on a grid around ``origin``, from some of the windows."""
        some = replace(self, reads=self.reads.chosen(self.reads.windows % THINNING == 0))
        states = [origin + np.array((x, y, h, 0.0, 0.0)) for x, y, h in itertools.product(SHIFTS, SHIFTS, HEADINGS)]
        return max(states, key=some.agreement)

    def climb(self, state: Array) -> Array:
        """The local maximum from ``state``."""
        # steps in metres, with a lever of a few metres for angles, to scale all five states equally
        unit = np.array((1.0, 1.0, 0.3, 1.0, 1.0))
        result = scipy.optimize.minimize(
            lambda v: -self.agreement(v * unit), state / unit, options={"eps": 1e-5, "gtol": 1e-4}
        )
        return np.asarray(result.x * unit)

    def _pose(self, state: Array) -> Array:
        """The pose of the world in the survey's frame."""
        return se2.inverse(self.survey(state).transform())

    def _likelihood(self, state: Array) -> PhaseLikelihood:
        x, y = map(float, state[3:])
        antennas = tuple(replace(a, x=a.x + x, y=a.y + y) for a in self.model.antennas)
        return PhaseLikelihood(replace(self.model, antennas=antennas), self.tags)


ENOUGH_STRENGTHS = 200
ITERATIONS = 30  # of the fit of the strength
DOF = (1.0, 100.0)


def fit_rssi(logs: Sequence[Log], rfid: RfidSettings, survey: SurveySettings) -> RssiSettings:
    """Fit the RSSI model (:mod:`factors.rfid.signals`) to all ``logs`` by maximum likelihood. InputError if a log has no
    reference, or too few reads have an RSSI.

    Signals below the reader's sensitivity are missing, so the path loss is flatter than in free space.
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
            f"{listed(log.name for log in logs)}: hold {count} reads with an RSSI, expected at least {ENOUGH_STRENGTHS}"
        )
    coefficients, sigma, dof = _student(np.concatenate(tables).reshape(-1, len(FEATURES)), np.concatenate(values))
    return RssiSettings.bounded(coefficients=tuple(coefficients.tolist()), sigma=sigma, dof=dof)


def _student(x: Array, y: Array) -> tuple[Array, float, float]:
    """Coefficients, scale and degrees of freedom, by conditional maximisation (Liu, Rubin, Stat. Sinica 5, 1995)."""
    dof, weights = 5.0, np.ones(len(y))
    for _ in range(ITERATIONS):
        root = np.sqrt(weights)
        coefficients: Array = np.linalg.lstsq(x * root[:, None], y * root, rcond=None)[0].astype(float)
        residuals = y - x @ coefficients
        sigma = math.sqrt(np.mean(weights * residuals**2))

        def cost(v: float, ratios: Array = residuals / sigma) -> float:
            dof = math.exp(v)  # mean negative log density of the Student distribution
            scale = gammaln(dof / 2.0) - gammaln((dof + 1.0) / 2.0) + 0.5 * math.log(dof * math.pi)
            return float(scale + 0.5 * (dof + 1.0) * np.mean(np.log1p(ratios**2 / dof)))

        dof = math.exp(minimize_scalar(cost, bounds=np.log(DOF), method="bounded").x)
        weights = (dof + 1.0) / (dof + (residuals / sigma) ** 2)
    return coefficients, sigma, dof

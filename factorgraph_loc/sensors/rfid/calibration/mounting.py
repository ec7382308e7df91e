"""Estimation of antenna mounting and survey transform from reads along the reference.

Fisher scoring of the likelihood of all reads. Standard errors are those of the sandwich estimator with clusters (Liang and Zeger,
"Longitudinal data analysis using generalized linear models", 1986), as reads within a block of time are correlated.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from factorgraph_loc.sensors.rfid.calibration.fit import Floor, Kind, fit
from factorgraph_loc.sensors.rfid.calibration.pairs import (
    BLOCKS,
    Terms,
    modelled,
    nearby,
    pairs_of,
    stretches,
    terms,
)
from factorgraph_loc.sensors.rfid.calibration.phase import PhaseFit
from factorgraph_loc.sensors.rfid.calibration.rounds import Rounds
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, RfidSettings, SurveySettings
from factors import se2
from factors.least_squares import minimum
from factors.rfid.model import DetectionModel
from factors.se2 import Array

ROUNDS = 3  # of fitting constants and model in turn
MOST_PAIRS = 60000  # per log
SURVEY = ("x", "y", "heading")
MOUNTING = ("x", "y", "yaw")
TYPICAL = {"x": 0.3, "y": 0.3, "heading": 0.1, "yaw": 0.2}  # m, rad; prior standard deviations
# error by confusion with the detection model, which is symmetric: m, rad
BLIND = {"x": 0.05, "y": 0.05, "heading": 0.02, "yaw": 0.1}
ITERATIONS = 4
STEP = 1e-4  # m, rad; of numerical derivatives


@dataclass(frozen=True)
class MountingConstant:
    """A constant of the survey (``antenna`` None), of all antennas jointly (-1), or of one antenna."""

    name: str
    antenna: int | None = None


@dataclass(frozen=True)
class Placing:
    """``settings`` and ``survey`` as found; changes (P,) of ``places`` with standard ``errors``; ``nll`` per round."""

    settings: RfidSettings
    survey: SurveySettings
    places: tuple[MountingConstant, ...]
    changes: Array
    errors: Array
    nll: float


@dataclass(frozen=True)
class Offset:
    """A change of survey or mounting, for tables: from the input, with its standard ``error`` [m or rad], whether it is ``kept``
    and ``why``. ``what``: survey, antennas or an antenna's name."""

    what: str
    name: str
    change: float
    error: float
    kept: bool
    why: str


SURVEY_PLACES = tuple(MountingConstant(name) for name in SURVEY)


def mounting_places(antennas: Sequence[int] = (-1,)) -> tuple[MountingConstant, ...]:
    """The mounting constants of all antennas jointly, or of each of ``antennas``."""
    return tuple(MountingConstant(name, a) for a in antennas for name in MOUNTING)


def with_focus(
    settings: RfidSettings, survey: SurveySettings, phase: PhaseFit
) -> tuple[RfidSettings, SurveySettings, tuple[Offset, ...]]:
    """Apply survey and lever arm from the phases if the phases agree better."""
    kept = phase.after > phase.before and bool(np.all(np.isfinite(phase.spread)))
    why = "kept: the phases of the reads agree" if kept else "not kept: the phases of the reads do not agree better"
    lever = phase.lever_arm
    pivot = np.array((phase.survey.about_x, phase.survey.about_y))
    before = (*(se2.transform_from(survey.transform(), pivot) - pivot).tolist(), survey.heading)
    after = (phase.survey.x, phase.survey.y, phase.survey.heading)
    moves = [
        *((("survey", name), b - a) for name, a, b in zip(SURVEY, before, after, strict=True)),
        (("antennas", "x"), lever[0]),
        (("antennas", "y"), lever[1]),
    ]
    offsets = tuple(
        Offset(*where, float(change), float(spread), kept, why)
        for (where, change), spread in zip(moves, phase.spread, strict=True)
    )
    if not kept:
        return settings, survey, offsets
    antennas, _ = moved(settings, survey, (MountingConstant("x", -1), MountingConstant("y", -1)), np.array(lever))
    return antennas, _rounded(phase.survey), offsets


def with_offsets(
    logs: Sequence[Rounds],
    settings: RfidSettings,
    survey: SurveySettings,
    kind: Kind,
    floor: Floor,
    *,
    focused: bool,
) -> tuple[RfidSettings, SurveySettings, tuple[Offset, ...]]:
    """Estimate survey and mounting from reads. With ``focused``, phases have determined all but the antennas' yaw.

    First survey and all antennas jointly, then each antenna. Insignificant changes are dropped, and the others are kept if they
    improve the likelihood of held-out reads.
    """
    logs = [_thinned(log) for log in logs]
    antennas = list(settings.all_antennas())
    offsets: list[Offset] = []
    common = (MountingConstant("yaw", -1),) if focused else (*SURVEY_PLACES, *mounting_places())
    apart = tuple(p for p in mounting_places(range(len(antennas))) if p.name == "yaw" or not focused)
    for places in (common, apart) if len(antennas) > 1 else (common,):
        clear = _clear(alternated(logs, settings, survey, places, kind, floor))
        gain = _gain(logs, settings, survey, clear, kind, floor) if clear else np.zeros(1)
        kept = bool(np.sum(gain) > 0.0 and np.mean(gain > 0.0) > 0.5) and bool(clear)
        found = alternated(logs, settings, survey, clear if kept else places, kind, floor)
        if places is common or kept:
            why = "kept: held-out reads are more likely" if kept else "not kept: below the resolution of reads"
            offsets += [
                Offset(_what(p, antennas), p.name, float(change), float(error), kept, why)
                for p, change, error in zip(found.places, found.changes, found.errors, strict=True)
            ]
        if kept:
            settings, survey = found.settings, found.survey
    return settings, _rounded(survey), tuple(offsets)


def alternated(
    logs: Sequence[Rounds],
    settings: RfidSettings,
    survey: SurveySettings,
    places: Sequence[MountingConstant],
    kind: Kind,
    floor: Floor,
) -> Placing:
    """Fit constants and a common detection model in turn."""
    changes = np.zeros(len(places))
    count = len(settings.all_antennas())
    for _ in range(ROUNDS):
        models, which = fit(pairs_of(logs, *moved(settings, survey, places, changes)), kind, floor, count)
        found = place(logs, settings, survey, places, models, which, floor, changes)
        changes = found.changes
    return found


def _clear(found: Placing) -> tuple[MountingConstant, ...]:
    """The significant constants, including the error by the detection model. The level allows one false positive among all
    constants in twenty calibrations."""
    blind = np.array([BLIND[p.name] for p in found.places])
    clear = np.abs(found.changes) > -ndtri(0.025 / len(blind)) * np.hypot(found.errors, blind)
    return tuple(p for p, c in zip(found.places, clear, strict=True) if c)


def _gain(
    logs: Sequence[Rounds],
    settings: RfidSettings,
    survey: SurveySettings,
    places: Sequence[MountingConstant],
    kind: Kind,
    floor: Floor,
) -> Array:
    """Gain of the held-out log-likelihood per fold, in nats, with constants and model fitted to the others."""
    if len(logs) > 1:
        folds = [([log for log in logs if log is not one], [one]) for one in logs]
    else:
        number = stretches(logs[0].t)
        folds = [([logs[0].part(number != k)], [logs[0].part(number == k)]) for k in range(BLOCKS)]
    gains = []
    for train, test in folds:
        after = alternated(train, settings, survey, places, kind, floor)
        nll = []
        for one in ((settings, survey), (after.settings, after.survey)):
            models, which = fit(pairs_of(train, *one), kind, floor, len(settings.all_antennas()))
            within = [nearby(log, settings, survey) for log in test]
            pairs = pairs_of(test, *one, within)
            logit = modelled(models, which, pairs)
            nll.append(np.sum(terms(logit, pairs.hits, pairs.count, floor.false_read, floor.miss).nll))
        gains.append(nll[0] - nll[1])
    return np.array(gains)


def _what(place: MountingConstant, antennas: Sequence[str]) -> str:
    if place.antenna is None:
        return "survey"
    return "antennas" if place.antenna < 0 else antennas[place.antenna]


def _thinned(log: Rounds) -> Rounds:
    return log.part(np.arange(len(log.t)) % (1 + log.hits.size // MOST_PAIRS) == 0)


def _rounded(survey: SurveySettings) -> SurveySettings:
    """Round to 1 mm and 0.1 mrad, for readability."""
    places = {"x": 3, "y": 3, "heading": 4, "about_x": 3, "about_y": 3}
    return survey.model_copy(update={name: round(getattr(survey, name), n) for name, n in places.items()})


def moved(
    settings: RfidSettings, survey: SurveySettings, places: Sequence[MountingConstant], changes: Array
) -> tuple[RfidSettings, SurveySettings]:
    """The rig's antennas and survey with changed constants."""
    antennas = dict(settings.all_antennas())
    names = list(antennas)
    for place, change in zip(places, changes.tolist(), strict=True):
        if place.antenna is None:
            survey = survey.model_copy(update={place.name: _added(place.name, getattr(survey, place.name), change)})
            continue
        for name in names if place.antenna < 0 else [names[place.antenna]]:
            old: AntennaSettings = antennas[name]
            antennas[name] = old.model_copy(update={place.name: _added(place.name, getattr(old, place.name), change)})
    # a preset has no positions that could be changed
    return settings.model_copy(update={"antennas": antennas, "preset": None}), survey


def place(
    logs: Sequence[Rounds],
    settings: RfidSettings,
    survey: SurveySettings,
    places: Sequence[MountingConstant],
    models: Sequence[DetectionModel],
    which: Sequence[int],
    floor: Floor,
    start: Array | None = None,
) -> Placing:
    """Maximum-likelihood ``places`` with given models and the weak prior :data:`TYPICAL`."""
    typical = np.array([TYPICAL[p.name] for p in places])
    within = [nearby(log, settings, survey) for log in logs]
    pairs = pairs_of(logs, settings, survey, within)

    def logit(values: Array) -> Array:
        return modelled(models, which, pairs_of(logs, *moved(settings, survey, places, values), within))

    def scored(values: Array) -> tuple[Terms, Array]:
        """The terms of the likelihood, and the derivatives (M, P) of the logits."""
        here = logit(values)
        jacobian = np.column_stack([(logit(values + e) - here) / STEP for e in STEP * np.eye(len(places))])
        return terms(here, pairs.hits, pairs.count, floor.false_read, floor.miss), jacobian

    def at(values: Array) -> tuple[float, Array, Array]:
        found, jacobian = scored(values)
        cost = float(np.sum(found.nll) + 0.5 * np.sum((values / typical) ** 2))
        curvature = jacobian.T @ (found.information[:, None] * jacobian) + np.diag(1.0 / typical**2)
        return cost, jacobian.T @ found.gradient + values / typical**2, curvature

    begin = np.zeros(len(places)) if start is None else start
    changes, _, curvature = minimum(at, begin, ITERATIONS, 0.01 * typical)
    found, jacobian = scored(changes)
    scores = found.gradient[:, None] * jacobian
    of_block = np.zeros((int(pairs.block.max()) + 1, len(places)))
    np.add.at(of_block, pairs.block, scores)
    bread = np.linalg.inv(curvature)
    errors = np.sqrt(np.diag(bread @ (of_block.T @ of_block) @ bread))
    changed, shifted = moved(settings, survey, places, changes)
    return Placing(changed, shifted, tuple(places), changes, errors, float(np.sum(found.nll) / np.sum(pairs.count)))


def _added(name: str, value: float, change: float) -> float:
    if name in ("heading", "yaw"):
        return float(se2.wrap_scalar(value + change))
    return value + change

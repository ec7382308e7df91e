"""Where the antennas sit and how the survey of the tags lies in the reference's frame, from what was read on the way.

Fisher scoring of the likelihood of all reads along the reference. Standard errors are those of the sandwich with clusters (Liang
and Zeger, "Longitudinal data analysis using generalized linear models", 1986): reads within a block of time go together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.calibration.rfid_fit import Floor
from factorgraph_loc.calibration.rfid_pairs import Pairs, modelled, nearby, pairs_of, terms
from factorgraph_loc.calibration.rfid_rounds import Rounds
from factorgraph_loc.rfid_settings import AntennaSettings, RfidSettings, SurveySettings
from factors import se2
from factors.rfid import DetectionModel
from factors.se2 import Array

SURVEY = ("x", "y", "heading")
MOUNTING = ("x", "y", "yaw")
TYPICAL = {"x": 0.3, "y": 0.3, "heading": 0.1, "yaw": 0.2}  # m, rad, standard deviations of what is wrong at first
ITERATIONS = 6
STEP = 1e-4  # m, rad, of numerical derivatives


@dataclass(frozen=True)
class Place:
    """Which constant: of the survey (``antenna`` None), of all antennas alike (-1), or of one of them."""

    name: str
    antenna: int | None = None


@dataclass(frozen=True)
class Placing:
    """``settings`` and ``survey`` as found; changes (P,) of ``places`` from the start with standard ``errors``; ``nll`` a round."""

    settings: RfidSettings
    survey: SurveySettings
    places: tuple[Place, ...]
    changes: Array
    errors: Array
    nll: float


def survey_places() -> tuple[Place, ...]:
    return tuple(Place(name) for name in SURVEY)


def mounting_places(antennas: Sequence[int] = (-1,)) -> tuple[Place, ...]:
    """Those of all antennas alike, or of each of ``antennas``."""
    return tuple(Place(name, a) for a in antennas for name in MOUNTING)


def moved(
    settings: RfidSettings, survey: SurveySettings, places: Sequence[Place], changes: Array
) -> tuple[RfidSettings, SurveySettings]:
    """The rig's antennas and survey with constants changed."""
    antennas = dict(settings.all_antennas())
    names = list(antennas)
    for place, change in zip(places, changes.tolist(), strict=True):
        if place.antenna is None:
            survey = survey.model_copy(update={place.name: _added(place.name, getattr(survey, place.name), change)})
            continue
        for name in names if place.antenna < 0 else [names[place.antenna]]:
            old: AntennaSettings = antennas[name]
            antennas[name] = old.model_copy(update={place.name: _added(place.name, getattr(old, place.name), change)})
    # a preset has no places of its own to change
    return settings.model_copy(update={"antennas": antennas, "preset": None}), survey


def place(
    logs: Sequence[Rounds],
    settings: RfidSettings,
    survey: SurveySettings,
    places: Sequence[Place],
    models: Sequence[DetectionModel],
    which: Sequence[int],
    floor: Floor,
) -> Placing:
    """The constants ``places`` that make what was read most likely, with given models; weakly held by :data:`TYPICAL`."""
    typical = np.array([TYPICAL[p.name] for p in places])
    within = [nearby(log, settings, survey) for log in logs]
    pairs = pairs_of(logs, settings, survey, within)
    changes = np.zeros(len(places))

    def seen(values: Array) -> Pairs:
        return pairs_of(logs, *moved(settings, survey, places, values), within)

    def logit(values: Array) -> Array:
        return modelled(models, which, seen(values))

    def likelihood(z: Array) -> Array:
        return terms(z, pairs.hits, pairs.count, floor.false_read, floor.miss).nll

    here = logit(changes)
    cost = float(np.sum(likelihood(here)))
    for _ in range(ITERATIONS):
        jacobian = np.column_stack([(logit(changes + e) - here) / STEP for e in STEP * np.eye(len(places))])
        found = terms(here, pairs.hits, pairs.count, floor.false_read, floor.miss)
        curvature = jacobian.T @ (found.information[:, None] * jacobian) + np.diag(1.0 / typical**2)
        step = np.linalg.solve(curvature, jacobian.T @ found.gradient + changes / typical**2)
        size = 1.0
        while size > 0.05 and float(np.sum(likelihood(logit(changes - size * step)))) > cost:
            size *= 0.5
        if size <= 0.05:
            break
        changes = changes - size * step
        here = logit(changes)
        cost = float(np.sum(likelihood(here)))
        if np.all(np.abs(size * step) < 0.01 * typical):
            break
    scores = found.gradient[:, None] * jacobian
    of_block = np.zeros((int(pairs.block.max()) + 1, len(places)))
    np.add.at(of_block, pairs.block, scores)
    bread = np.linalg.inv(curvature)
    errors = np.sqrt(np.diag(bread @ (of_block.T @ of_block) @ bread))
    changed, shifted = moved(settings, survey, places, changes)
    return Placing(changed, shifted, tuple(places), changes, errors, cost / float(np.sum(pairs.count)))


def _added(name: str, value: float, change: float) -> float:
    return se2.wrap_scalar(value + change) if name in ("heading", "yaw") else value + change

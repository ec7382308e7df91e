"""Survey, mounting and detection model of RFID as one problem of maximal posterior density.

The likelihood of reads and misses has a floor (:func:`~factorgraph_loc.sensors.rfid.calibration.pairs.terms`). The logit of a
detection model is differentiated numerically by its parameters. Its derivatives by position and facing of the tags give those by
the survey's transform and by the antennas' mounting.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from factorgraph_loc.fitting.posterior import (
    LikelihoodTerms,
    Parameter,
    Posterior,
    by_block,
    maximise,
)
from factorgraph_loc.sensors.rfid.calibration.pairs import REACH, Floor, TagPairs, nearby, pairs_of, seen, terms
from factorgraph_loc.sensors.rfid.calibration.rounds import Integers, Rounds
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, RfidSettings, SurveySettings
from factors import se2
from factors.rfid.model import FEATURES, NEAR, BeamModel, DetectionModel, GridModel, LogisticModel, logits
from factors.rfid.parameters import MOST_CERTAIN, OF_MODEL, rate_of
from factors.se2 import Array

FACING = tuple(i for i, name in enumerate(FEATURES) if "c" in name)
EDGE = 5.0  # pseudo-rounds without reads at the maximum range, so that extrapolations do not grow with distance
VAGUE = 1e3  # standard deviation of the prior of a constant without any
STEP = 1e-4  # of numerical derivatives
MOST_PAIRS = 60000  # per log, for survey and mounting
BEAM = {  # bounds of the logit of p0, and of logarithms
    "p0": (-3.0, 7.0),
    "r_max": (np.log(0.3), np.log(2.0 * REACH)),
    "s_r": (np.log(0.05), np.log(5.0)),
    "sigma_phi": (np.log(0.1), np.log(9.0)),
}
SURVEY = {"x": 0.1, "y": 0.1, "heading": 0.05}  # m, rad; standard deviations of the priors
MOUNTING = {"x": 0.05, "y": 0.05, "yaw": 0.15}  # of what all antennas have in common
APART = 0.7  # times these: what each antenna has besides
ALL = "antennas"


@dataclass(frozen=True)
class Family:
    """Detection models: ``built`` of values (P,) of ``parameters``. ``shown``: values for tables, and their derivatives by the
    parameters. ``design``: of a linear logit, its derivatives (M, P) at points (M, 3) and facings (M,)."""

    parameters: tuple[Parameter, ...]
    built: Callable[[Array], DetectionModel]
    shown: Callable[[Array], tuple[Array, Array]]
    design: Callable[[Array, Array], Array] | None = None

    def jacobian(self, values: Array, points: Array, facing: Array) -> Array:
        """Derivatives (M, P) of the logits of tags at ``points`` (M, 3)."""
        if self.design is not None:
            return self.design(points, facing)
        here = logits(self.built(values), points, facing)[0]
        steps = STEP * np.eye(len(values))
        moved = [logits(self.built(values + step), points, facing)[0] - here for step in steps]
        return np.column_stack(moved) / STEP


def features(points: Array, facing: Array) -> Array:
    """The features (M, 11) of :data:`factors.rfid.model.FEATURES`."""
    x, y, z = points.T
    r = np.sqrt(x**2 + y**2 + NEAR**2)
    w, c = 1.0 - x / r, facing
    return np.column_stack((np.ones_like(r), r, r**2, w, w**2, r * w, np.abs(z), c, c**2, r * c, w * c))


def logistic(pairs: TagPairs, *, with_facing: bool) -> Family:
    """Logistic models. The prior of a coefficient is standard normal for a feature with unit spread in ``pairs``."""
    every = _edged(pairs)
    scale = np.std(features(every.points, every.facing), axis=0)
    used = [i for i in range(len(FEATURES)) if i == 0 or (scale[i] > 1e-6 and (with_facing or i not in FACING))]

    def built(values: Array) -> LogisticModel:
        full = np.zeros(len(FEATURES))
        full[used] = values
        return LogisticModel(tuple(full.tolist()), REACH)

    sigmas = [1.0 / scale[i] if i else VAGUE for i in used]
    parameters = [Parameter(f"coefficient of {FEATURES[i]}", 0.0, float(s)) for i, s in zip(used, sigmas, strict=True)]
    return Family(
        tuple(parameters),
        built,
        lambda values: (values, np.ones(len(values))),
        lambda points, facing: features(points, facing)[:, used],
    )


def beam(start: BeamModel) -> Family:
    """Beams about ``start``, with its share of reads from behind."""

    def built(values: Array) -> BeamModel:
        r_max, s_r, sigma_phi = np.exp(values[1:]).tolist()
        return BeamModel(float(1.0 / (1.0 + np.exp(-values[0]))), r_max, s_r, sigma_phi, start.behind)

    def shown(values: Array) -> tuple[Array, Array]:
        p0, *others = 1.0 / (1.0 + np.exp(-values[0])), *np.exp(values[1:])
        return np.array((p0, *others)), np.array((p0 * (1.0 - p0), *others))

    p0 = min(max(start.p0, 1e-3), 1.0 - 1e-3)
    means = (_logit(p0), *np.log((start.r_max, start.s_r, start.sigma_phi)).tolist())
    return Family(
        tuple(Parameter(n, min(max(m, a), b), 2.0, a, b) for (n, (a, b)), m in zip(BEAM.items(), means, strict=True)),
        built,
        shown,
    )


def scaled(start: GridModel) -> Family:
    """Grids with the shape of ``start`` and another range and rate: see :mod:`factors.rfid.parameters`."""
    peak = min(start.peak, MOST_CERTAIN)

    def built(values: Array) -> GridModel:
        p = np.clip(rate_of(peak, values[1]) / (1.0 + np.exp(-start.logits)), 1e-6, 1.0 - 1e-6)
        factor = float(np.exp(values[0]))
        cells = {name: factor * getattr(start, name) for name in ("x0", "y0", "cell")}
        return replace(start, logits=np.log(p / (1.0 - p)), **cells)

    parameters = tuple(Parameter(name, 0.0, 0.5, -2.0, 2.0) for name in OF_MODEL)
    return Family(parameters, built, lambda values: (values, np.ones(2)))


def family_of(model: DetectionModel, pairs: TagPairs) -> Family:
    """The models like a given one."""
    if isinstance(model, BeamModel):
        return beam(model)
    return scaled(model) if isinstance(model, GridModel) else logistic(pairs, with_facing=model.uses_facing)


def fit_model(pairs: TagPairs, family: Family, floor: Floor) -> tuple[DetectionModel, Posterior]:
    """The model of maximal posterior density for ``pairs``."""
    data = _edged(pairs) if family.design else pairs
    design = family.design(data.points, data.facing) if family.design else None

    def at(values: Array) -> LikelihoodTerms:
        logit = logits(family.built(values), data.points, data.facing)[0]
        jacobian = family.jacobian(values, data.points, data.facing) if design is None else design
        return _evidence(logit, jacobian, data, floor)

    found = maximise(family.parameters, at)
    return family.built(found.values), found


@dataclass(frozen=True)
class Placing:
    """``settings`` and ``survey`` with the changes whose posterior is ``found``: of the survey, and of each antenna."""

    settings: RfidSettings
    survey: SurveySettings
    found: Posterior


def places_of(settings: RfidSettings, better: Sequence[Parameter] = ()) -> tuple[Parameter, ...]:
    """The changes of survey and mounting: of all antennas, and of each if there are several. ``better``: priors that replace the
    usual ones."""
    places = [Parameter(f"survey.{name}", 0.0, sigma) for name, sigma in SURVEY.items()]
    places += [Parameter(f"{ALL}.{name}", 0.0, sigma) for name, sigma in MOUNTING.items()]
    names = list(settings.all_antennas())
    for antenna in names if len(names) > 1 else ():
        places += [Parameter(f"{antenna}.{name}", 0.0, APART * sigma) for name, sigma in MOUNTING.items()]
    replaced = {p.name: p for p in better}
    return tuple(replaced.get(p.name, p) for p in places)


def place(
    logs: Sequence[Rounds],
    settings: RfidSettings,
    survey: SurveySettings,
    floor: Floor,
    better: Sequence[Parameter] = (),
    *,
    with_facing: bool,
) -> Placing:
    """Survey and mounting of maximal posterior density, together with a logistic model of all antennas."""
    count = max(len(nearby(log, settings, survey)) for log in logs)
    logs = [log.part(np.arange(len(log.t)) % (1 + count // MOST_PAIRS) == 0) for log in logs]
    places = places_of(settings, better)
    within = [nearby(log, settings, survey) for log in logs]
    pairs = pairs_of(logs, settings, survey, within)
    family = logistic(pairs, with_facing=with_facing)
    begin = fit_model(pairs, family, floor)[1]

    def at(values: Array) -> LikelihoodTerms:
        changes, model = values[: len(places)], values[len(places) :]
        there = moved(settings, survey, places, changes)
        data = _edged(pairs_of(logs, *there, within))
        logit, gradient = logits(family.built(model), data.points, data.facing)
        by_places = np.zeros((len(logit), len(places)))
        by_places[: len(pairs.hits)] = _by_places(logs, *there, within, places, gradient[: len(pairs.hits)])
        jacobian = np.hstack((by_places, family.jacobian(model, data.points, data.facing)))
        return _evidence(logit, jacobian, data, floor)

    found = maximise((*places, *family.parameters), at, begin.as_dict())
    return Placing(*moved(settings, survey, places, found.values[: len(places)]), _of_antennas(found, places, settings))


def _of_antennas(found: Posterior, places: Sequence[Parameter], settings: RfidSettings) -> Posterior:
    """The posterior of the survey, and of each antenna with what all have in common."""
    names = [p.name for p in places]
    rows = [[names.index(f"survey.{name}")] for name in SURVEY]
    rows += [
        [names.index(f"{what}.{name}") for what in (ALL, antenna) if f"{what}.{name}" in names]
        for antenna in settings.all_antennas()
        for name in MOUNTING
    ]
    total = np.zeros((len(rows), len(found.values)))
    for i, columns in enumerate(rows):
        total[i, columns] = 1.0
    labels = [f"survey.{name}" for name in SURVEY]
    labels += [f"antennas.{antenna}.{name}" for antenna in settings.all_antennas() for name in MOUNTING]
    before = [p.sigma for p in places_of(settings)]
    sigmas = [math.hypot(*(before[column] for column in columns)) for columns in rows]
    parameters = tuple(Parameter(label, 0.0, sigma) for label, sigma in zip(labels, sigmas, strict=True))
    return Posterior(parameters, total @ found.values, total @ found.covariance @ total.T, found.share)


def moved(
    settings: RfidSettings, survey: SurveySettings, places: Sequence[Parameter], changes: Array
) -> tuple[RfidSettings, SurveySettings]:
    """The rig's antennas and survey with ``changes`` (P,) of places."""
    antennas = dict(settings.all_antennas())
    for parameter, change in zip(places, changes.tolist(), strict=True):
        what, _, name = parameter.name.rpartition(".")
        if what == "survey":
            survey = survey.model_copy(update={name: _added(name, getattr(survey, name), change)})
            continue
        for antenna in antennas if what == ALL else [what]:
            old: AntennaSettings = antennas[antenna]
            antennas[antenna] = old.model_copy(update={name: _added(name, getattr(old, name), change)})
    # a preset has no positions that could be changed
    return settings.model_copy(update={"antennas": antennas, "preset": None}), survey


def _added(name: str, value: float, change: float) -> float:
    return float(se2.wrap_scalar(value + change)) if name in ("heading", "yaw") else value + change


def _by_places(
    logs: Sequence[Rounds],
    settings: RfidSettings,
    survey: SurveySettings,
    within: Sequence[Integers],
    places: Sequence[Parameter],
    gradient: Array,
) -> Array:
    """Derivatives (M, P) of logits by places, from their ``gradient`` (M, 4) by points and facing."""
    pivot = np.array((survey.about_x + survey.x, survey.about_y + survey.y))
    names = list(settings.all_antennas())
    out, first = [], 0
    for log, chosen in zip(logs, within, strict=True):
        derivatives = seen(log, settings, survey, chosen).jacobian(gradient[first : first + len(chosen)], pivot)
        first += len(chosen)
        antenna = log.antenna[chosen // len(log.names)]
        columns = []
        for parameter in places:
            what, _, name = parameter.name.rpartition(".")
            column = derivatives[:, list(SURVEY).index(name) if what == "survey" else 3 + list(MOUNTING).index(name)]
            columns.append(column * (antenna == names.index(what)) if what in names else column)
        out.append(np.column_stack(columns))
    return np.concatenate(out)


def _evidence(logit: Array, jacobian: Array, pairs: TagPairs, floor: Floor) -> LikelihoodTerms:
    """The likelihood of reads. Those of a tag are correlated: some tags are stronger than others."""
    found = terms(logit, pairs.hits, pairs.count, floor)
    information = jacobian.T @ (found.information[:, None] * jacobian)
    scores = by_block(found.gradient[:, None] * jacobian, pairs.tag)
    return LikelihoodTerms(float(np.sum(found.nll)), scores, information)


def _edged(pairs: TagPairs) -> TagPairs:
    """The pairs, and pseudo-rounds without reads around the antenna at the maximum range."""
    axes = np.linspace(-np.pi, np.pi, 24, endpoint=False), (-1.0, 0.0, 1.0), np.linspace(-1.0, 1.0, 5)
    bearing, height, facing = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    edge = np.column_stack((REACH * np.cos(bearing), REACH * np.sin(bearing), height))
    none, zero = np.zeros(len(edge)), np.zeros(len(edge), dtype=np.int64)
    added = TagPairs(edge, facing, none, none + EDGE / len(edge), zero, zero, zero, zero)
    columns = [f.name for f in fields(TagPairs)]
    return TagPairs(**{name: np.concatenate((getattr(pairs, name), getattr(added, name))) for name in columns})


def _logit(p: float) -> float:
    return float(np.log(p / (1.0 - p)))

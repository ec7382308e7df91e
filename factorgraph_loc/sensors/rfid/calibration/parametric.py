"""Maximum a posteriori estimates of parametric detection models, and of survey and mounting together with a model.

The likelihood of reads and misses includes false reads (:func:`~factorgraph_loc.sensors.rfid.calibration.pairs.terms`).
Derivatives by parameters of a model, by the survey's transform and by the antennas' mounting are numerical.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from factorgraph_loc.fitting.posterior import (
    LikelihoodTerms,
    Parameter,
    Posterior,
    by_block,
    independent_share,
    maximise,
)
from factorgraph_loc.sensors.rfid.calibration.pairs import REACH, Floor, TagPairs, modelled, nearby, pairs_of, terms
from factorgraph_loc.sensors.rfid.calibration.rounds import Rounds
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, RfidSettings, SurveySettings
from factors import se2
from factors.rfid.model import FEATURES, NEAR, BeamModel, DetectionModel, GridModel, LogisticModel, logits
from factors.rfid.parameters import MOST_CERTAIN, OF_MODEL, rate_of
from factors.se2 import Array, Integers

FACING = tuple(i for i, name in enumerate(FEATURES) if "c" in name)  # features that depend on the facing
EDGE = 5.0  # weight of artificial misses at the maximum range, so that read probabilities do not grow with distance
VAGUE = 1e3  # standard deviation of a flat prior
STEP = 1e-4  # step of numerical derivatives
WINDOW = 10.0  # s; reads in different windows are treated as independent
MOST_PAIRS = 60000  # maximum number of pairs per log in the fit of survey and mounting
# bounds of the parameters of a beam
BEAM = {"p0": (0.05, 0.999), "r_max": (0.3, 2.0 * REACH), "s_r": (0.05, 5.0), "sigma_phi": (0.1, 9.0)}
SURVEY = {"survey.x": 0.1, "survey.y": 0.1, "survey.heading": 0.05}  # m, rad; standard deviations of the priors
# m, rad; prior standard deviations of a change of the mounting that all antennas share
COMMON = {"antennas.x": 0.05, "antennas.y": 0.05, "antennas.yaw": 0.15}
APART = 0.7  # prior standard deviation of the additional change of each antenna, as a fraction of COMMON
NO_FOCUS: Mapping[str, tuple[float, float]] = {}


@dataclass(frozen=True)
class Family:
    """A family of detection models with P parameters.

    ``parameters``: the P parameters with priors. ``built``: a function from values (P,) of the parameters to the model.
    ``design``: a function from points (M, 3) and facings (M,) of tags to the derivatives (M, P) of the logit of a read
    by the parameters. It is None if the logit is not linear in the parameters. Points and facings are those of
    :meth:`jacobian`.
    """

    parameters: tuple[Parameter, ...]
    built: Callable[[Array], DetectionModel]
    design: Callable[[Array, Array], Array] | None = None

    def jacobian(self, values: Array, points: Array, facing: Array) -> Array:
        """Return the derivatives (M, P) of the logit of the read probability by the parameters. ``values`` (P,): the
        parameters.

        ``points`` (M, 3): positions of tags in the antenna frame [m]. ``facing`` (M,): cosine of the angle between the
        direction of the tag's front and the direction to the antenna.
        """
        if self.design is not None:
            return self.design(points, facing)
        start = logits(self.built(values), points, facing)[0]
        steps = STEP * np.eye(len(values))
        moved = [logits(self.built(values + step), points, facing)[0] - start for step in steps]
        return np.column_stack(moved) / STEP


def features(points: Array, facing: Array) -> Array:
    """Return the features (M, 11) in :data:`factors.rfid.model.FEATURES` of M tags. ``points`` (M, 3): their positions
    in the antenna frame [m]. ``facing`` (M,): cosine of the angle between the tag's front and the direction to the
    antenna."""
    x, y, z = points.T
    r = np.sqrt(x**2 + y**2 + NEAR**2)
    w, c = 1.0 - x / r, facing
    return np.column_stack((np.ones_like(r), r, r**2, w, w**2, r * w, np.abs(z), c, c**2, r * c, w * c))


def logistic(pairs: TagPairs, *, with_facing: bool) -> Family:
    """Return the family of logistic models. Coefficients have Gaussian priors with mean 0. Their standard deviations
    are 1 over the standard deviation of the feature in ``pairs``. The constant has a flat prior. ``with_facing``: True
    to use the features that depend on the facing of tags."""
    every = _with_edge_misses(pairs)
    scale = np.std(features(every.points, every.facing), axis=0)
    used = [i for i in range(len(FEATURES)) if i == 0 or (scale[i] > 1e-6 and (with_facing or i not in FACING))]

    def built(values: Array) -> LogisticModel:
        full = np.zeros(len(FEATURES))
        full[used] = values
        return LogisticModel(tuple(full.tolist()), REACH)

    sigmas = [1.0 / scale[i] if i else VAGUE for i in used]
    parameters = [Parameter(f"coefficient of {FEATURES[i]}", 0.0, float(s)) for i, s in zip(used, sigmas, strict=True)]
    return Family(tuple(parameters), built, lambda points, facing: features(points, facing)[:, used])


def beam(start: BeamModel) -> Family:
    """Return the family of beam models with priors around ``start``. The parameter ``behind`` (ratio of read
    probabilities behind and in front of a tag) is not fitted, but taken from ``start``."""
    parameters = []
    for name, (low, high) in BEAM.items():
        mean = min(max(getattr(start, name), low), high)
        parameters.append(Parameter(name, mean, 2.0 * mean, low, high))
    return Family(tuple(parameters), lambda values: replace(start, **dict(zip(BEAM, values.tolist(), strict=True))))


def scaled(start: GridModel) -> Family:
    """Return the family of grids that differ from ``start`` only in range and read rate. Its two parameters are changes
    of range and read rate, defined in :mod:`factors.rfid.parameters`."""
    peak = min(start.peak, MOST_CERTAIN)

    def built(values: Array) -> GridModel:
        p = np.clip(rate_of(peak, values[1]) / (1.0 + np.exp(-start.logits)), 1e-6, 1.0 - 1e-6)
        factor = float(np.exp(values[0]))
        cells = {name: factor * getattr(start, name) for name in ("x0", "y0", "cell")}
        return replace(start, logits=np.log(p / (1.0 - p)), **cells)

    parameters = tuple(Parameter(name, 0.0, 0.5, -2.0, 2.0) for name in OF_MODEL)
    return Family(parameters, built)


def family_of(model: DetectionModel, pairs: TagPairs) -> Family:
    """Return the family of models of the same kind as ``model``. ``pairs``: data for the priors of logistic models."""
    if isinstance(model, BeamModel):
        return beam(model)
    return scaled(model) if isinstance(model, GridModel) else logistic(pairs, with_facing=model.uses_facing)


def fit_model(pairs: TagPairs, family: Family, floor: Floor) -> tuple[DetectionModel, Posterior]:
    """Return the maximum a posteriori detection model of a ``family``, and the posterior of its parameters. ``pairs``:
    reads and misses. ``floor``: minimum probabilities of a read and of a miss."""
    data = _with_edge_misses(pairs) if family.design else pairs
    design = family.design(data.points, data.facing) if family.design else None

    def at(values: Array) -> LikelihoodTerms:
        logit = logits(family.built(values), data.points, data.facing)[0]
        jacobian = family.jacobian(values, data.points, data.facing) if design is None else design
        # reads of a tag are correlated, because tags differ in strength
        return _evidence(logit, jacobian, data, floor, data.tag)

    posterior = maximise(family.parameters, at)
    return family.built(posterior.values), posterior


def geometry_parameters(
    settings: RfidSettings, focus: Mapping[str, tuple[float, float]] = NO_FOCUS
) -> tuple[tuple[Parameter, ...], Array]:
    """Return P parameters and the covariance (P, P) of their prior. The parameters are changes of the survey transform
    and of the mounting of each antenna.

    The change of an antenna is a change that all antennas share, plus an own change if there are several antennas.
    ``focus``: priors (mean, standard deviation) of changes by name, such as "antennas.x", instead of the defaults.
    """
    priors = {name: (0.0, sigma) for name, sigma in (SURVEY | COMMON).items()} | dict(focus)
    antennas = settings.all_antennas()
    own = {name: APART * sigma * (len(antennas) > 1) for name, sigma in COMMON.items()}
    parameters = [Parameter(name, *priors[name]) for name in SURVEY]
    for antenna in antennas:
        for name, sigma in own.items():
            mean, common = priors[name]
            parameters.append(Parameter(name.replace(".", f".{antenna}."), mean, math.hypot(common, sigma)))
    covariance = np.diag([p.sigma**2 for p in parameters])
    kinds = [kind_of(p)[0] for p in parameters]
    for i, k in itertools.permutations(range(len(SURVEY), len(kinds)), 2):
        covariance[i, k] = priors[kinds[i]][1] ** 2 * (kinds[i] == kinds[k])
    return tuple(parameters), covariance


def kind_of(parameter: Parameter) -> tuple[str, str]:
    """Return the kind of a parameter of :func:`geometry_parameters`, such as "antennas.x", and the name of its antenna.
    The antenna is "" for a parameter of the survey."""
    what, _, rest = parameter.name.partition(".")
    antenna, _, name = rest.rpartition(".")
    return f"{what}.{name}", antenna


def estimate_geometry(
    logs: Sequence[Rounds],
    settings: RfidSettings,
    survey: SurveySettings,
    floor: Floor,
    focus: Mapping[str, tuple[float, float]] = NO_FOCUS,
    *,
    with_facing: bool,
) -> tuple[RfidSettings, SurveySettings, Posterior]:
    """Return maximum a posteriori estimates of the survey transform and of the mounting of the antennas.

    They are estimated together with a logistic model for all antennas. Returns ``settings`` and ``survey``, both
    updated, and the posterior of the changes. ``floor``: minimum probabilities of a read and of a miss. ``focus``:
    priors of changes as in :func:`geometry_parameters`. ``with_facing``: True if the model depends on the facing of
    tags.
    """
    count = max(len(nearby(log, settings, survey)) for log in logs)
    logs = [log.part(np.arange(len(log.t)) % (1 + count // MOST_PAIRS) == 0) for log in logs]
    places, prior = geometry_parameters(settings, focus)
    kinds, names, number = [kind_of(p) for p in places], list(settings.all_antennas()), len(places)
    within = [nearby(log, settings, survey) for log in logs]
    pairs = pairs_of(logs, settings, survey, within)
    family = logistic(pairs, with_facing=with_facing)
    begin = fit_model(pairs, family, floor)[1]

    def at(values: Array) -> LikelihoodTerms:
        model, changed = family.built(values[number:]), with_changes(settings, survey, places, values[:number])
        data = _with_edge_misses(pairs_of(logs, *changed, within))
        logit, columns = logits(model, data.points, data.facing)[0], np.zeros((len(data.points), number))
        for kind in SURVEY | COMMON:
            steps = STEP * np.array([name == kind for name, _ in kinds])
            step = _with_edge_misses(pairs_of(logs, *with_changes(*changed, places, steps), within))
            change = (logits(model, step.points, step.facing)[0] - logit) / STEP
            for i in np.flatnonzero(steps):
                antenna = kinds[i][1]
                columns[:, i] = change * (data.antenna == names.index(antenna)) if antenna else change
        jacobian = np.hstack((columns, family.jacobian(values[number:], data.points, data.facing)))
        # reads of a tag are correlated, because tags differ in strength
        return _evidence(logit, jacobian, data, floor, data.tag)

    covariance = np.diag([p.sigma**2 for p in (*places, *family.parameters)])
    covariance[:number, :number] = prior
    posterior = maximise((*places, *family.parameters), at, begin.as_dict(), covariance)
    changes, matrix = posterior.values[:number], posterior.covariance[:number, :number]
    return *with_changes(settings, survey, places, changes), Posterior(places, changes, matrix, posterior.share)


def with_changes(
    settings: RfidSettings, survey: SurveySettings, places: Sequence[Parameter], changes: Array
) -> tuple[RfidSettings, SurveySettings]:
    """Return copies of ``settings`` and ``survey`` with the ``changes`` (P,) added. ``places``: the P parameters that
    change, from :func:`geometry_parameters`."""
    antennas = dict(settings.all_antennas())
    for place, change in zip(places, changes.tolist(), strict=True):
        antenna, name = kind_of(place)[1], place.name.rpartition(".")[2]
        old: SurveySettings | AntennaSettings = antennas[antenna] if antenna else survey
        value = getattr(old, name) + change
        new = old.model_copy(update={name: se2.wrap_scalar(value) if name in ("heading", "yaw") else value})
        if isinstance(new, SurveySettings):
            survey = new
        else:
            antennas[antenna] = new
    # a preset has fixed positions, so that its antennas must be listed instead
    return settings.model_copy(update={"antennas": antennas, "preset": None}), survey


def pose_share(
    logs: Sequence[Rounds],
    settings: RfidSettings,
    survey: SurveySettings,
    models: Sequence[DetectionModel],
    which: Sequence[int],
    floor: Floor,
) -> float:
    """Return the Fisher information of the reads on the pose, divided by its value for independent reads. It is below 1
    because reads in a time window are correlated. ``logs``: rounds that are not merged. ``survey``: the transform of
    the tags to the world frame. ``which``: the index in ``models`` for each antenna. ``floor``: minimum probabilities
    of a read and of a miss."""
    within = [nearby(log, settings, survey) for log in logs]
    pairs = pairs_of(logs, settings, survey, within, WINDOW)
    logit, columns = modelled(models, which, pairs), []
    for step in STEP * np.eye(3):
        stepped = [replace(log, poses=se2.compose(log.poses, step)) for log in logs]
        columns.append((modelled(models, which, pairs_of(stepped, settings, survey, within)) - logit) / STEP)
    evidence = _evidence(logit, np.column_stack(columns), pairs, floor, pairs.block)
    return independent_share(evidence.scores, evidence.information)


def _evidence(logit: Array, jacobian: Array, pairs: TagPairs, floor: Floor, block: Integers) -> LikelihoodTerms:
    """Return the likelihood of ``pairs``. ``logit`` (M,): predicted logits of the read probability. ``jacobian`` (M,
    P): their derivatives by P parameters. ``block`` (M,): a group index of each pair. Pairs of one group are treated as
    correlated."""
    likelihood = terms(logit, pairs.hits, pairs.count, floor)
    information = jacobian.T @ (likelihood.information[:, None] * jacobian)
    scores = by_block(likelihood.gradient[:, None] * jacobian, block)
    return LikelihoodTerms(float(np.sum(likelihood.nll)), scores, information)


def _with_edge_misses(pairs: TagPairs) -> TagPairs:
    """Return ``pairs`` with additional artificial misses at the maximum range around the antenna."""
    axes = np.linspace(-np.pi, np.pi, 24, endpoint=False), (-1.0, 0.0, 1.0), np.linspace(-1.0, 1.0, 5)
    bearing, height, facing = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    edge = np.column_stack((REACH * np.cos(bearing), REACH * np.sin(bearing), height))
    none, zero = np.zeros(len(edge)), np.zeros(len(edge), dtype=np.int64)
    added = TagPairs(edge, facing, none, none + EDGE / len(edge), zero, zero, zero, zero)
    columns = [f.name for f in fields(TagPairs)]
    return TagPairs(**{name: np.concatenate((getattr(pairs, name), getattr(added, name))) for name in columns})

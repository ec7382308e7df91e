"""RFID settings learnt along trajectories: survey, mounting, detection models, tempering, strength and phase.

Along references all of these are learnt. Along trajectories that the smoother found, the likelihood of the reads is averaged over
the poses that it thinks possible (:func:`~factorgraph_loc.sensors.smoothed.possible_poses`), and models keep their kind: a beam is
fitted in all its parameters, a logistic model in all its coefficients, and a grid in its range and rate.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import file_name
from factorgraph_loc.fitting.posterior import FittedConstant, Parameter, blocks, by_block, independent_share
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import SensorKnowledge
from factorgraph_loc.sensors.rfid.calibration.fields import CrossValidation, Kind, choose, fit
from factorgraph_loc.sensors.rfid.calibration.pairs import (
    BLOCKS,
    Floor,
    TagPairs,
    modelled,
    nearby,
    pairs_of,
    seen,
    terms,
)
from factorgraph_loc.sensors.rfid.calibration.parametric import Placing, family_of, fit_model, place
from factorgraph_loc.sensors.rfid.calibration.phase import PhaseFit, fit_phase
from factorgraph_loc.sensors.rfid.calibration.rounds import Rounds, distinct, rounds_of
from factorgraph_loc.sensors.rfid.calibration.rssi import fit_rssi
from factorgraph_loc.sensors.rfid.settings import (
    BeamSettings,
    GridSettings,
    LogisticSettings,
    PhaseSettings,
    PriorSettings,
    RfidSettings,
    RfidUncertainty,
    SurveySettings,
    write_grid,
)
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.sensors.smoothed import REFERENCE_GAP, Traced, pooled, possible_poses
from factorgraph_loc.text import quoted
from factors import se2
from factors.rfid.model import FEATURES, BeamModel, DetectionModel, GridModel, LogisticModel, logits
from factors.rfid.parameters import OF_MODEL
from factors.se2 import Array

DEFAULT = "default"
CALIBRATED = PriorSettings(range_scale=0.02, read_rate=0.1)  # between the days of one installation
WINDOW = 10.0  # s; reads in different windows are independent
MIN_READS = 100.0  # weighted reads that a model is learnt from
COEFFICIENT = "coefficient of "
VAGUE = 0.5  # relative standard error of a parameter that is not determined
BURSTS = 1.3  # rounds that are worth one; less is no reason to change the tempering


@dataclass(frozen=True)
class RfidFit:
    """The result along references.

    ``models``, and ``which`` of them each antenna has; their ``kind``, and the ``trials`` of others; ``phase``: the focus, if logs
    have phases; ``share`` of reads that are worth independent ones; ``pairs``: the data.
    """

    models: tuple[DetectionModel, ...]
    which: tuple[int, ...]
    antennas: tuple[str, ...]
    kind: Kind
    trials: tuple[CrossValidation, ...]
    phase: PhaseFit | None
    share: float
    pairs: TagPairs


def learn_rfid(logs: Sequence[Log], rig: Rig, grids: Path, kind: Kind | None = None) -> SensorKnowledge:
    """Learn the RFID settings of a rig from ``logs`` with references; ``grids``: path and name prefix of learnt grids.

    Logs with the same reads count once. With a ``kind``, only models of that kind are fitted. InputError if a log has too few
    rounds.
    """
    numbers = distinct(logs)
    logs = [log for i, log in enumerate(logs) if numbers.index(numbers[i]) == i]
    settings = rig.of(RfidSettings)
    floor = floor_of(settings)
    rounds = [rounds_of(log, settings) for log in logs]
    facing = any(np.any(np.isfinite(one.tags.facing)) for one in rounds)
    survey = _about_the_middle(rounds, rig.survey)
    phase = _focus([log for log in logs if log.world == logs[0].world and _has_phases(log)], settings, survey)
    told = () if phase is None else _focused(phase, survey)
    placing = place(rounds, settings, survey, floor, told, with_facing=facing)
    settings, survey = placing.settings, placing.survey
    pairs, names = pairs_of(rounds, settings, survey), tuple(settings.all_antennas())
    trials: tuple[CrossValidation, ...] = ()
    if kind is None:
        kind, trials = choose(pairs, floor, len(names), facing=facing)
    models, which = fit(pairs, kind, floor, len(names))
    settings = _with_models(settings, models, which, grids, floor)
    settings = _with_signals(logs, settings, survey, focused=bool(told))
    apart = [rounds_of(log, settings, merged=False) for log in logs]
    together, _ = bursts(pairs, modelled(models, which, pairs), floor)
    share = min(pose_share(apart, settings, survey, models, which, floor), 1.0 / together)
    return SensorKnowledge(
        {"rfid": settings.model_copy(update={"tempering": share}), "survey": survey},
        _place_constants(placing),
        details=RfidFit(models, which, names, kind, trials, phase, share, pairs),
        correlations=placing.found.correlations(),
    )


def relearn_rfid(traced: Sequence[Traced], rig: Rig, first: Rig, grids: Path) -> SensorKnowledge:
    """The detection models of ``rig``, their priors and the tempering, from smoothed logs; ``first``: the rig before all turns,
    about whose models the priors are."""
    settings, started = rig.of(RfidSettings), first.of(RfidSettings)
    floor = floor_of(started)
    pairs = pairs_of([_possible(one, settings) for one in traced], settings, rig.survey)
    if len(traced) == 1:
        pairs = replace(pairs, fold=2 * pairs.fold // BLOCKS)  # the halves of a single log
    names, of_antenna = list(settings.models), [a.model for a in settings.all_antennas().values()]
    models, constants, notes = dict(settings.models), list[FittedConstant](), list[str]()
    for name, labels in settings.parameter_names().items():
        part = pairs.part(np.isin(pairs.antenna, [i for i, model in enumerate(of_antenna) if model == name]))
        if part.hits.sum() < MIN_READS:
            notes.append(
                f"The antennas of model {quoted(name)} read {part.hits.sum():.0f} tags, expected {MIN_READS:.0f}: it stays."
            )
        elif (found := _refitted(part, started.models[name].model(), name, floor)) is None:
            notes.append(f"The logs hardly determine the model {quoted(name)} of the antennas: it stays.")
        else:
            constants += found[1]
            models[name] = written(found[0], name, grids).model_copy(update={"prior": _prior(traced, labels)})
    fitted = [models[name].model() for name in names]
    together, error = bursts(pairs, modelled(fitted, [names.index(model) for model in of_antenna], pairs), floor)
    before = started.tempering
    tempering = 1.0 / together if together > BURSTS and together * before > 1.0 else before
    constants.append(FittedConstant("rfid", "tempering", before, tempering, max(error / together**2, 1e-4)))
    changes = {"models": models, "false_read": floor.false_read, "miss": floor.miss, "tempering": tempering}
    changes["uncertainty"] = RfidUncertainty(**started.uncertainties())  # nothing was learnt of mounting and clock
    return SensorKnowledge({"rfid": settings.model_copy(update=changes)}, constants, notes)


def _refitted(
    pairs: TagPairs, before: DetectionModel, name: str, floor: Floor
) -> tuple[DetectionModel, list[FittedConstant]] | None:
    """A model of the kind of ``before`` and its parameters, each also for single logs; None if a beam is not determined."""
    family = family_of(before, pairs)
    model, found = fit_model(pairs, family, floor)
    values, unit = family.shown(found.values)
    errors = unit * found.errors
    if isinstance(before, BeamModel) and np.any(errors > VAGUE * np.abs(values)):
        return None
    logs = [fit_model(pairs.part(pairs.fold == i), family, floor)[1] for i in np.unique(pairs.fold)]
    each = np.array([family.shown(one.values)[0] for one in logs])
    known = family.shown(np.array([p.mean for p in family.parameters]))[0]
    if isinstance(before, LogisticModel):
        of_feature = dict(zip(FEATURES, before.coefficients, strict=True))
        known = np.array([of_feature[p.name.removeprefix(COEFFICIENT)] for p in family.parameters])
    rows = zip(family.parameters, known.tolist(), values.tolist(), errors.tolist(), each.T.tolist(), strict=True)
    return model, [
        FittedConstant("rfid", f"models.{name}.{p.name}", old, new, error, per_log=tuple(own))
        for p, old, new, error, own in rows
    ]


def _prior(traced: Sequence[Traced], labels: Sequence[str]) -> PriorSettings:
    """The scatter between logs of the range and rate that the smoother estimated, by their ``labels``."""
    spreads = {}
    for kind, label in zip(OF_MODEL, labels, strict=True):
        told = [one.constants[f"rfid.{label}"] for one in traced if one.constants and f"rfid.{label}" in one.constants]
        if len(told) == len(traced):
            spreads[kind] = min(pooled(told, getattr(CALIBRATED, kind)).spread, 1.0)
    return CALIBRATED.model_copy(update=spreads)


def _possible(one: Traced, settings: RfidSettings) -> Rounds:
    """The rounds of a smoothed log, without doubted tags, at poses that scatter as the smoother thinks possible."""
    found = rounds_of(one.log, settings)
    kept = np.array([name not in one.doubted for name in found.names])
    if kept.sum() < 2:
        raise InputError(
            f"{one.log.name}: {kept.sum()} of the {len(kept)} tags that were read are believed to be where the map has them, "
            "expected 2 or more to learn from without a reference"
        )
    assert one.log.reference is not None
    return replace(
        found,
        poses=possible_poses(one.log.reference, found.t, REFERENCE_GAP),
        hits=found.hits[:, kept],
        tags=replace(found.tags, points=found.tags.points[kept], facing=found.tags.facing[kept]),
        names=tuple(name for name, keep in zip(found.names, kept, strict=True) if keep),
    )


def _place_constants(placing: Placing) -> list[FittedConstant]:
    """The changes of survey and mounting."""
    found = zip(placing.found.parameters, placing.found.values, placing.found.errors, strict=True)
    return [FittedConstant("rfid", p.name, 0.0, float(value), float(error), p.sigma) for p, value, error in found]


def bursts(pairs: TagPairs, logit: Array, floor: Floor) -> tuple[float, float]:
    """How many rounds are worth an independent one, at least 1, and its standard error: by the scatter of each tag's reads by each
    antenna in blocks of time. ``logit`` (M,): of the model.

    Unlike the gradient by the pose, this scatter hardly depends on trajectories that were found by the same reads. It is a ratio
    of variances (McCullagh and Nelder, "Generalized linear models", 1989, section 4.5), with the error of a ratio over blocks.
    """
    p = floor.probability(logit)
    key = (pairs.block * (pairs.tag.max() + 1) + pairs.tag) * (pairs.antenna.max() + 1) + pairs.antenna
    _, first, cell = np.unique(key, return_index=True, return_inverse=True)
    excess, variance = np.bincount(cell, pairs.hits - pairs.count * p), np.bincount(cell, pairs.count * p * (1.0 - p))
    block = pairs.block[first]
    observed, expected = np.bincount(block, excess**2), np.bincount(block, variance)
    ratio = float(observed.sum() / max(float(expected.sum()), 1e-9))
    error = float(np.sqrt(np.sum((observed - ratio * expected) ** 2)) / max(float(expected.sum()), 1e-9))
    return max(1.0, ratio), error


def pose_share(
    logs: Sequence[Rounds],
    settings: RfidSettings,
    survey: SurveySettings,
    models: Sequence[DetectionModel],
    which: Sequence[int],
    floor: Floor,
) -> float:
    """The share of independent information on the pose in the reads of unmerged rounds."""
    scores, information = [], np.zeros((3, 3))
    for log in logs:
        chosen = nearby(log, settings, survey)
        view, row = seen(log, settings, survey, chosen), chosen // len(log.names)
        logit, gradient = np.empty(len(chosen)), np.empty((len(chosen), 4))
        mine = np.asarray(which)[log.antenna[row]]
        for i, model in enumerate(models):
            logit[mine == i], gradient[mine == i] = logits(model, view.points[mine == i], view.facing[mine == i])
        by_x, by_y, by_yaw = view.jacobian(gradient, np.zeros(2)).T[3:]
        turned = by_yaw - view.mounted[:, 1] * by_x + view.mounted[:, 0] * by_y
        jacobian = np.column_stack((by_x, by_y, turned))
        found = terms(logit, log.hits.ravel()[chosen], log.count[row], floor)
        scores.append(by_block(found.gradient[:, None] * jacobian, blocks([log.t], WINDOW)[row]))
        information += jacobian.T @ (found.information[:, None] * jacobian)
    return independent_share(np.concatenate(scores), information)


def _focus(logs: Sequence[Log], settings: RfidSettings, survey: SurveySettings) -> PhaseFit | None:
    """The focus by phases; None if there are too few phases near their tags, or they do not agree better than before."""
    try:
        found = fit_phase(logs, settings, survey) if logs else None
    except InputError:
        return None
    return found if found is not None and found.after > found.before and np.all(np.isfinite(found.spread)) else None


def _focused(phase: PhaseFit, survey: SurveySettings) -> tuple[Parameter, ...]:
    """The priors of survey and lever arm that the phases give."""
    pivot = np.array((phase.survey.about_x, phase.survey.about_y))
    before = (*(se2.transform_from(survey.transform(), pivot) - pivot).tolist(), survey.heading)
    after = (phase.survey.x, phase.survey.y, phase.survey.heading)
    names = ("survey.x", "survey.y", "survey.heading", "antennas.x", "antennas.y")
    changes = (*np.subtract(after, before).tolist(), *phase.lever_arm)
    return tuple(Parameter(n, m, s) for n, m, s in zip(names, changes, phase.spread.tolist(), strict=True))


def _has_phases(log: Log) -> bool:
    stream = log.streams["rfid"]
    assert isinstance(stream, RfidStream)
    return bool(np.any(np.isfinite(stream.phase)))


def floor_of(settings: RfidSettings) -> Floor:
    """The rig's floor if given, else one that is robust to a few wrong tags and reads."""
    given = settings.model_fields_set & {"false_read", "miss"}
    return Floor(settings.false_read, settings.miss) if given else Floor()


def _about_the_middle(rounds: Sequence[Rounds], survey: SurveySettings) -> SurveySettings:
    """The survey with its rotation about the centre of the tags, if uncorrected, to separate shift and rotation."""
    if survey != SurveySettings():
        return survey
    places = {name: point for one in rounds for name, point in zip(one.names, one.tags.points[:, :2], strict=True)}
    x, y = np.mean(list(places.values()), axis=0).round(2).tolist()
    return SurveySettings.bounded(about_x=x, about_y=y)


def _with_models(
    settings: RfidSettings, models: Sequence[DetectionModel], which: Sequence[int], grids: Path, floor: Floor
) -> RfidSettings:
    antennas = dict(settings.all_antennas())
    # a model of a single antenna has the antenna's name
    names = [DEFAULT] * len(models)
    if len(models) > 1:
        names = [next((a for a, w in zip(antennas, which, strict=True) if w == i), DEFAULT) for i in range(len(models))]
    models_of = {name: written(model, name, grids) for name, model in zip(names, models, strict=True)}
    antennas = {
        a: s.model_copy(update={"x": round(s.x, 4), "y": round(s.y, 4), "yaw": round(s.yaw, 5), "model": names[w]})
        for (a, s), w in zip(antennas.items(), which, strict=True)
    }
    return settings.model_copy(
        update={
            "antennas": antennas,
            "preset": None,
            "models": models_of,
            "uncertainty": RfidUncertainty(),  # as well as the models
            "false_read": floor.false_read,
            "miss": floor.miss,
        }
    )


def _with_signals(
    logs: Sequence[Log], settings: RfidSettings, survey: SurveySettings, *, focused: bool
) -> RfidSettings:
    """The settings with models for strength, if logs have it, and for phase, if it was focused, as the geometry is too inaccurate
    otherwise. The rig's sensors determine whether they are used."""
    changes: dict[str, object] = {}
    try:
        strength = fit_rssi(logs, settings, survey)
    except InputError:  # too few reads have a strength
        pass
    else:
        tempering = strength.tempering if settings.rssi is None else settings.rssi.tempering
        changes["rssi"] = strength.model_copy(update={"tempering": tempering})
    if focused and settings.phase is None:
        changes["phase"] = PhaseSettings()
    return settings.model_copy(update=changes)


def written(model: DetectionModel, name: str, grids: Path) -> BeamSettings | LogisticSettings | GridSettings:
    """The settings of a learnt model; a grid is written to a file with the prefix ``grids``."""
    if isinstance(model, BeamModel):
        return BeamSettings.bounded(
            p0=round(model.p0, 4),
            r_max=round(model.r_max, 3),
            s_r=round(model.s_r, 3),
            sigma_phi=round(model.sigma_phi, 3),
            behind=round(model.behind, 3),
            prior=CALIBRATED,
        )
    if isinstance(model, LogisticModel):
        b = [round(value, 4) for value in model.coefficients]
        return LogisticSettings(
            coefficients=(b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7], b[8], b[9], b[10]), prior=CALIBRATED
        )
    assert isinstance(model, GridModel)
    file = f"{grids.name}.{_safe(name)}.npz"
    write_grid(model, grids.with_name(file))
    return GridSettings(file=file, prior=CALIBRATED).placed(grids.parent)


def _safe(name: str) -> str:
    """A name that is a valid file name on every system and unique per antenna."""
    safe = file_name("".join(c if c.isalnum() or c in "-_" else "-" for c in name))
    return safe if safe == name else f"{safe}-{hashlib.sha256(name.encode('utf-8', 'surrogatepass')).hexdigest()[:8]}"

"""Estimates RFID settings: survey transform, mounting, detection models, tempering, and models of strength and phase.

All of these are estimated from logs with references. From smoothed logs, only tempering and detection models of the
same kind as before are estimated, with poses drawn from the smoothed trajectory
(:func:`~factorgraph_loc.sensors.smoothed.possible_poses`). Of grids, only range and read rate are fitted then. The
smoother itself estimates the yaws of antennas and the time offset.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import file_name
from factorgraph_loc.fitting.posterior import FittedConstant
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import SensorKnowledge
from factorgraph_loc.sensors.rfid.calibration.fields import Kind, choose, fit
from factorgraph_loc.sensors.rfid.calibration.pairs import Floor, TagPairs, modelled, pairs_of
from factorgraph_loc.sensors.rfid.calibration.parametric import (
    SURVEY,
    estimate_geometry,
    family_of,
    fit_model,
    geometry_parameters,
    pose_share,
)
from factorgraph_loc.sensors.rfid.calibration.rounds import Rounds, overdispersion, rounds_of
from factorgraph_loc.sensors.rfid.calibration.signals import PhaseFit, fit_phase, fit_rssi
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
from factorgraph_loc.sensors.smoothed import (
    Traced,
    corrections_of,
    pooled,
    possible_poses,
    recordings,
)
from factorgraph_loc.text import Notice, notice, quoted
from factors import se2
from factors.rfid.model import FEATURES, BeamModel, DetectionModel, GridModel, LogisticModel
from factors.rfid.parameters import OF_MODEL
from factors.se2 import Array

DEFAULT = "default"
# prior of a calibrated model: standard deviations of the changes between days in one building
CALIBRATED = PriorSettings(range_scale=0.02, read_rate=0.1)
MIN_READS = 100.0  # minimum (weighted) number of reads for the fit of a model
COEFFICIENT = "coefficient of "
VAGUE = 0.5  # maximum standard error of a parameter, as a fraction of its value
BURSTS = 1.3  # minimum overdispersion for a change of the tempering


@dataclass(frozen=True)
class RfidFit:
    """Fitted detection models and their data. The calibration report plots them.

    ``models``: the models. ``which``: the index in ``models`` for each antenna. ``antennas``: names of the antennas.
    ``kind``: the kind of all models. ``pairs``: the reads and misses that the models are fitted to.
    """

    models: tuple[DetectionModel, ...]
    which: tuple[int, ...]
    antennas: tuple[str, ...]
    kind: Kind
    pairs: TagPairs


def learn_rfid(logs: Sequence[Log], rig: Rig, grids: Path, kind: Kind | None = None) -> SensorKnowledge:
    """Return the RFID settings of ``rig``, estimated from ``logs`` with references, as the result of a calibration.

    If several logs have the same reads, only one is used. ``grids``: path and name prefix of files for detection grids.
    ``kind``: the kind of detection model, None to choose the best kind. Raises InputError if a log has too few rounds.
    """
    logs = [log for i, log in enumerate(logs) if recordings(logs)[i] == i]
    settings = rig.of(RfidSettings)
    floor = floor_of(settings)
    rounds = [rounds_of(log, settings) for log in logs]
    facing = any(np.any(np.isfinite(log.tags.facing)) for log in rounds)
    survey = _about_the_middle(rounds, rig.survey)
    phase = _geometry_by_phases([log for log in logs if log.world == logs[0].world], settings, survey)
    focus = {} if phase is None else _priors_of(phase, survey)
    settings, survey, posterior = estimate_geometry(rounds, settings, survey, floor, focus, with_facing=facing)
    places = zip(geometry_parameters(settings)[0], posterior.values.tolist(), posterior.errors.tolist(), strict=True)
    pairs, names = pairs_of(rounds, settings, survey), tuple(settings.all_antennas())
    scores = dict[Kind, float]()
    if kind is None:
        kind, scores = choose(pairs, floor, len(names), facing=facing)
    models, which = fit(pairs, kind, floor, len(names))
    settings = _with_models(settings, models, which, grids, floor)
    settings = _with_signals(logs, settings, survey, focused=phase is not None)
    single = [rounds_of(log, settings, merged=False) for log in logs]
    excess, _ = _overdispersion(pairs, modelled(models, which, pairs), floor)
    share = min(pose_share(single, settings, survey, models, which, floor), 1.0 / excess)
    rows = [{"model": tried.label(), "held_out_nll": nll, "best": tried == kind} for tried, nll in scores.items()]
    figures = {"independent_share": share, "models": rows}
    if phase is not None:
        figures |= {"initial_phase_agreement": phase.initial_agreement, "phase_agreement": phase.agreement}
    return SensorKnowledge(
        {"rfid": settings.model_copy(update={"tempering": share}), "survey": survey},
        [FittedConstant("rfid", p.name, 0.0, value, error, p.sigma) for p, value, error in places],
        figures=figures,
        details=RfidFit(models, which, names, kind, pairs),
        correlations=posterior.correlations(),
    )


def relearn_rfid(traced: Sequence[Traced], rig: Rig, first: Rig, grids: Path) -> SensorKnowledge:
    """Return the RFID settings of ``rig``, estimated from the smoothed logs ``traced``, as the result of a calibration.

    ``rig``: the rig with which the logs were smoothed. ``first``: the rig before the first iteration of smoothing and
    calibration. Priors are around its values. ``grids``: path and name prefix of files for detection grids.
    """
    settings, initial = rig.of(RfidSettings), first.of(RfidSettings)
    floor = floor_of(initial)
    pairs = pairs_of([_sampled_rounds(trace, settings) for trace in traced], settings, rig.survey)
    names, of_antenna = list(settings.models), [a.model for a in settings.all_antennas().values()]
    models, constants, notes = dict(settings.models), list[FittedConstant](), list[Notice]()
    for name, labels in settings.parameter_names().items():
        part = pairs.part(np.isin(pairs.antenna, [i for i, model in enumerate(of_antenna) if model == name]))
        if part.hits.sum() < MIN_READS:
            sentence = "The model {model} is unchanged: its antennas have {reads:.0f} reads, expected {expected:.0f}."
            notes.append(notice("few_reads", sentence, quoted(name), part.hits.sum(), MIN_READS))
        elif (fitted := _refitted(part, initial.models[name].model(), name, floor)) is None:
            sentence = "The model {model} is unchanged, because the logs hardly determine it."
            notes.append(notice("undetermined_model", sentence, quoted(name)))
        else:
            constants += fitted[1]
            models[name] = written(fitted[0], name, grids).model_copy(update={"prior": _prior(traced, labels)})
    fits = [models[name].model() for name in names]
    excess, error = _overdispersion(pairs, modelled(fits, [names.index(model) for model in of_antenna], pairs), floor)
    known = initial.tempering
    tempering = 1.0 / excess if excess > BURSTS and excess * known > 1.0 else known
    constants.append(FittedConstant("rfid", "tempering", known, tempering, max(error / excess**2, 1e-4)))
    settings, mounting = _mounted(traced, settings, initial)
    changes = {"models": models, "false_read": floor.false_read, "miss": floor.miss, "tempering": tempering}
    # keep the uncertainties, because their defaults would become smaller with the new priors of the models
    changes["uncertainty"] = RfidUncertainty(**initial.uncertainties())
    return SensorKnowledge({"rfid": settings.model_copy(update=changes)}, [*constants, *mounting], notes)


def _mounted(
    traced: Sequence[Traced], settings: RfidSettings, initial: RfidSettings
) -> tuple[RfidSettings, list[FittedConstant]]:
    """Return ``settings`` with the antenna yaws and the time offset that the smoother estimated, and a list of these
    constants. ``traced``: the smoothed logs. Constants that the logs do not determine get their value in
    ``initial``."""
    known, antennas, constants = initial.uncertainties(), dict(settings.all_antennas()), list[FittedConstant]()
    common = corrections_of("rfid.yaw", traced)
    for name, antenna in antennas.items():
        own = corrections_of(f"rfid.antennas.{name}.yaw", traced) or [(0.0, 0.0)] * len(common)
        yaws = [(a + b, math.hypot(s, t)) for (a, s), (b, t) in zip(common, own, strict=False)]
        prior = math.hypot(known["yaw"], known["antenna_yaw"] * (len(antennas) > 1))
        start = initial.all_antennas()[name].yaw
        current = start + se2.wrap_scalar(antenna.yaw - start)
        if constant := _mean(f"antennas.{name}.yaw", yaws, start, current, prior):
            constants.append(constant)
            antennas[name] = antenna.model_copy(update={"yaw": round(se2.wrap_scalar(constant.fitted), 5)})
    offset, clock = settings.time_offset, corrections_of("rfid.time_offset", traced)
    if constant := _mean("time_offset", clock, initial.time_offset, offset, known["time_offset"]):
        constants.append(constant)
        offset = constant.fitted
    return settings.model_copy(update={"antennas": antennas, "preset": None, "time_offset": offset}), constants


def _mean(
    name: str, corrections: Sequence[tuple[float, float]], initial: float, value: float, prior: float
) -> FittedConstant | None:
    """Return a constant that is the same in all logs, or None if ``corrections`` is empty. Its value is ``value`` plus
    the mean correction, or ``initial`` if the logs do not determine the constant. ``corrections``: a correction and its
    standard deviation for each log. ``prior``: the standard deviation of the constant before the calibration."""
    if not corrections:
        return None
    each, errors = np.array(corrections).T
    error = max(float(np.sqrt(np.mean(errors**2))), float(np.std(each))) / math.sqrt(len(each))
    constant = FittedConstant("rfid", name, initial, value + float(each.mean()), error, prior, tuple(value + each))
    return constant if constant.is_determined else replace(constant, fitted=initial)


def _refitted(
    pairs: TagPairs, initial: DetectionModel, name: str, floor: Floor
) -> tuple[DetectionModel, list[FittedConstant]] | None:
    """Return a detection model of the same kind as ``initial``, fitted to ``pairs``, and its parameters. Returns None
    for a beam model that ``pairs`` do not determine. ``name``: the name of the model. ``floor``: minimum probabilities
    of a read and of a miss."""
    family = family_of(initial, pairs)
    model, posterior = fit_model(pairs, family, floor)
    if isinstance(initial, BeamModel) and np.any(posterior.errors > VAGUE * np.abs(posterior.values)):
        return None
    known = [p.mean for p in family.parameters]
    if isinstance(initial, LogisticModel):
        of_feature = dict(zip(FEATURES, initial.coefficients, strict=True))
        known = [of_feature[p.name.removeprefix(COEFFICIENT)] for p in family.parameters]
    rows = zip(family.parameters, known, posterior.values.tolist(), posterior.errors.tolist(), strict=True)
    return model, [FittedConstant("rfid", f"models.{name}.{p.name}", *figures) for p, *figures in rows]


def _prior(traced: Sequence[Traced], labels: Sequence[str]) -> PriorSettings:
    """Return the prior of a detection model: the standard deviations of its range and its read rate between logs. The
    values of each log were estimated by the smoother. ``labels``: the names of both parameters in the constants of each
    log in ``traced``."""
    scatters = {}
    for kind, label in zip(OF_MODEL, labels, strict=True):
        if corrections := corrections_of(f"rfid.{label}", traced):
            scatters[kind] = min(pooled(corrections, getattr(CALIBRATED, kind)).scatter, 1.0)
    return CALIBRATED.model_copy(update=scatters)


def _sampled_rounds(trace: Traced, settings: RfidSettings) -> Rounds:
    """Return the rounds of a log at poses that are drawn from its smoothed trajectory. Tags that have probably moved
    are omitted. Raises InputError if fewer than two tags remain."""
    rounds = rounds_of(trace.log, settings)
    kept = np.array([name not in trace.doubted for name in rounds.names])
    if kept.sum() < 2:
        raise InputError(
            f"{trace.log.name}: {kept.sum()} of the {len(kept)} tags that were read are at their position in the map, "
            "expected 2 or more for a calibration without a reference"
        )
    assert trace.log.reference is not None
    return replace(
        rounds,
        poses=possible_poses(trace.log.reference, rounds.t),
        hits=rounds.hits[:, kept],
        tags=replace(rounds.tags, points=rounds.tags.points[kept], facing=rounds.tags.facing[kept]),
        names=tuple(name for name, keep in zip(rounds.names, kept, strict=True) if keep),
    )


def _overdispersion(pairs: TagPairs, logit: Array, floor: Floor) -> tuple[float, float]:
    """Return the overdispersion of the reads in ``pairs`` and its standard error, see :func:`.overdispersion`.
    ``logit`` (M,): predicted logits of the probability of a read. ``floor``: minimum probabilities of a read and a
    miss."""
    return overdispersion(pairs.hits, pairs.count, floor.probability(logit), pairs.antenna, pairs.tag, pairs.block)


def _geometry_by_phases(logs: Sequence[Log], settings: RfidSettings, survey: SurveySettings) -> PhaseFit | None:
    """Return the survey transform and the correction of antenna positions, estimated from the phases in ``logs``.
    Returns None if there are too few phases, or if the estimates do not improve the agreement of the phases.
    ``survey``: the initial transform."""
    try:
        phase = fit_phase(logs, settings, survey)
    except InputError:
        return None
    return phase if phase.agreement > phase.initial_agreement and np.isfinite(phase.sigmas).all() else None


def _priors_of(phase: PhaseFit, survey: SurveySettings) -> dict[str, tuple[float, float]]:
    """Return the changes of survey transform and antenna positions that the fit ``phase`` determines: (mean, standard
    deviation) by name, such as "antennas.x". ``survey``: the transform before the fit."""
    shift = (phase.survey.x - survey.x, phase.survey.y - survey.y, phase.survey.heading - survey.heading)
    names = (*SURVEY, "antennas.x", "antennas.y")
    return dict(zip(names, zip((*shift, *phase.lever_arm), phase.sigmas.tolist(), strict=True), strict=True))


def floor_of(settings: RfidSettings) -> Floor:
    """Return the probabilities of false reads and misses in ``settings``. If these are not set, return the defaults of
    :class:`Floor`, with which fits are robust to a few wrong tags and reads."""
    given = settings.model_fields_set & {"false_read", "miss"}
    return Floor(settings.false_read, settings.miss) if given else Floor()


def _about_the_middle(rounds: Sequence[Rounds], survey: SurveySettings) -> SurveySettings:
    """Return an identity transform that rotates about the centre of the tags, so that translation and rotation are
    uncorrelated. If ``survey`` is not the default, it is returned unchanged."""
    if survey != SurveySettings():
        return survey
    places = {name: point for log in rounds for name, point in zip(log.names, log.tags.points[:, :2], strict=True)}
    x, y = np.mean(list(places.values()), axis=0).round(2).tolist()
    return SurveySettings.bounded(about_x=x, about_y=y)


def _with_models(
    settings: RfidSettings, models: Sequence[DetectionModel], which: Sequence[int], grids: Path, floor: Floor
) -> RfidSettings:
    """Return ``settings`` with the fitted detection ``models``. Grids are written to files with the path prefix
    ``grids``. ``which``: the index of the model of each antenna. ``floor``: probabilities of false reads and misses."""
    antennas = dict(settings.all_antennas())
    names = [DEFAULT] * len(models)
    if len(models) > 1:  # a model gets the name of its antenna
        names = [next((a for a, w in zip(antennas, which, strict=True) if w == i), DEFAULT) for i in range(len(models))]
    antennas = {
        a: s.model_copy(update={"x": round(s.x, 4), "y": round(s.y, 4), "yaw": round(s.yaw, 5), "model": names[w]})
        for (a, s), w in zip(antennas.items(), which, strict=True)
    }
    return settings.model_copy(
        update={
            "antennas": antennas,
            "preset": None,
            "models": {name: written(model, name, grids) for name, model in zip(names, models, strict=True)},
            "uncertainty": RfidUncertainty(),  # the defaults are proportional to the priors of the models
            "false_read": floor.false_read,
            "miss": floor.miss,
        }
    )


def _with_signals(
    logs: Sequence[Log], settings: RfidSettings, survey: SurveySettings, *, focused: bool
) -> RfidSettings:
    """Return ``settings`` with models of signal strength (if the logs have it) and of phase (if ``focused``).
    ``focused``: True if the geometry was estimated from phases. Otherwise it is too inaccurate to use phases."""
    changes: dict[str, object] = {}
    try:
        strength = fit_rssi(logs, settings, survey)
        tempering = strength.tempering if settings.rssi is None else settings.rssi.tempering
        changes["rssi"] = strength.model_copy(update={"tempering": tempering})
    except InputError:  # too few reads have a strength
        pass
    if focused and settings.phase is None:
        changes["phase"] = PhaseSettings()
    return settings.model_copy(update=changes)


def written(model: DetectionModel, name: str, grids: Path) -> BeamSettings | LogisticSettings | GridSettings:
    """Return the settings of the fitted model ``name``. A grid is written to a file with the path prefix ``grids``."""
    if isinstance(model, BeamModel):
        values = {field: round(value, 4) for field, value in asdict(model).items()}
        return BeamSettings.bounded(**values, prior=CALIBRATED)
    if isinstance(model, LogisticModel):
        return LogisticSettings(coefficients=tuple(round(b, 4) for b in model.coefficients), prior=CALIBRATED)
    assert isinstance(model, GridModel)
    file = f"{grids.name}.{_safe(name)}.npz"
    write_grid(model, grids.with_name(file))
    return GridSettings(file=file, prior=CALIBRATED).placed(grids.parent)


def _safe(name: str) -> str:
    """Return a unique file name for ``name`` that is valid on every operating system."""
    safe = file_name("".join(c if c.isalnum() or c in "-_" else "-" for c in name))
    return safe if safe == name else f"{safe}-{hashlib.sha256(name.encode('utf-8', 'surrogatepass')).hexdigest()[:8]}"

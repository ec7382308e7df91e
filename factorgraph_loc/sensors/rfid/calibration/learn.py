"""Learning of RFID settings from logs with reference poses: survey, mounting, detection model, doubtful tags."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import file_name
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.rfid.calibration.dead import DeadTags, dead_tags
from factorgraph_loc.sensors.rfid.calibration.fit import Floor, Kind, ModelSelection, choose, fit
from factorgraph_loc.sensors.rfid.calibration.mounting import Offset, with_focus, with_offsets
from factorgraph_loc.sensors.rfid.calibration.pairs import TagPairs, pairs_of
from factorgraph_loc.sensors.rfid.calibration.phase import PhaseFit, fit_phase
from factorgraph_loc.sensors.rfid.calibration.rounds import Rounds, distinct, rounds_of
from factorgraph_loc.sensors.rfid.calibration.rssi import fit_rssi
from factorgraph_loc.sensors.rfid.calibration.tags import TagDoubt, misplaced
from factorgraph_loc.sensors.rfid.calibration.tempering import independent_share, tempered
from factorgraph_loc.sensors.rfid.settings import (
    BeamSettings,
    GridSettings,
    LogisticSettings,
    PhaseSettings,
    PriorSettings,
    RfidSettings,
    SurveySettings,
    write_grid,
)
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factors.rfid.model import BeamModel, DetectionModel, GridModel, LogisticModel

DEFAULT = "default"
CALIBRATED = PriorSettings(range_scale=0.02, read_rate=0.1)  # between the days of one installation


@dataclass(frozen=True)
class RfidKnowledge:
    """The result of learning RFID.

    ``models``, and ``which`` of them each antenna has; ``choice`` of the model; ``offsets`` of survey and mounting; ``phase``: the
    focus, if logs have phases; ``share``: exponent at which the likelihood matches the reads' scatter along the reference;
    ``doubts``: misplaced tags; ``dead``: dead tags. ``pairs``: the data of the models.
    """

    models: tuple[DetectionModel, ...]
    which: tuple[int, ...]
    antennas: tuple[str, ...]
    choice: ModelSelection
    offsets: tuple[Offset, ...]
    phase: PhaseFit | None
    share: float
    doubts: tuple[TagDoubt, ...]
    dead: DeadTags
    pairs: TagPairs
    floor: Floor


def learn_rfid(
    logs: Sequence[Log], rig: Rig, grids: Path, kind: Kind | None = None, *, placed: bool = True
) -> tuple[Rig, RfidKnowledge | None]:
    """Learn the RFID settings of a rig from ``logs``; ``grids``: path and name prefix of learnt grids.

    Logs with the same reads count once. With a ``kind``, only models of that kind are fitted, and the knowledge is None. Without
    ``placed``, tags and antennas keep the positions of ``rig``. InputError if the rig has no antennas or a log has too few
    rounds.
    """
    settings = rig.rfid
    if settings is None:
        raise InputError(f"{logs[0].name}: its rig has no RFID antennas, expected their mounting in [rfid.antennas]")
    numbers = distinct(logs)
    logs = [log for i, log in enumerate(logs) if numbers.index(numbers[i]) == i]
    floor = floor_of(settings)
    rounds = [rounds_of(log, settings) for log in logs]
    survey = _about_the_middle(rounds, rig.survey)
    facing = any(np.any(np.isfinite(one.tags.facing)) for one in rounds)
    offsets: tuple[Offset, ...] = ()
    phase: PhaseFit | None = None
    if placed:
        settings, survey, offsets, phase = _placed(logs, rounds, settings, survey, floor, facing=facing)
    pairs = pairs_of(rounds, settings, survey)
    names = tuple(settings.all_antennas())
    choice = None if kind is not None else choose(pairs, floor, len(names), facing=facing)
    used = choice.kind if choice is not None else kind
    assert used is not None
    models, which = fit(pairs, used, floor, len(names))
    settings = _with_models(settings, models, which, grids, floor)
    settings = _with_signals(logs, settings, survey, focused=phase is not None)
    rig = rig.model_copy(update={"rfid": settings, "survey": survey})
    if choice is None:
        return rig, None
    apart = [rounds_of(log, settings, merged=False) for log in logs]
    share = independent_share(apart, settings, survey, models, which, floor)
    rig = tempered(rig, share**-0.5)
    dead = dead_tags(logs, rounds, rig)
    assert rig.rfid is not None
    rig = rig.model_copy(update={"rfid": rig.rfid.model_copy(update={"dead_tags": dead.share})})
    knowledge = RfidKnowledge(
        models,
        which,
        names,
        choice,
        offsets,
        phase,
        share,
        misplaced(rounds, settings, survey, models, which, floor),
        dead,
        pairs,
        floor,
    )
    return rig, knowledge


def _placed(
    logs: Sequence[Log],
    rounds: Sequence[Rounds],
    settings: RfidSettings,
    survey: SurveySettings,
    floor: Floor,
    *,
    facing: bool,
) -> tuple[RfidSettings, SurveySettings, tuple[Offset, ...], PhaseFit | None]:
    """Survey and mounting: from phases if there are any, and the rest from reads."""
    settings = settings.model_copy(update={"antennas": dict(settings.all_antennas()), "preset": None})
    phase = _focus([log for log in logs if log.world == logs[0].world and _has_phases(log)], settings, survey)
    focused: tuple[Offset, ...] = ()
    if phase is not None:
        settings, survey, focused = with_focus(settings, survey, phase)
    kind = Kind("logistic", facing)
    settings, survey, found = with_offsets(rounds, settings, survey, kind, floor, focused=bool(focused))
    return settings, survey, (*focused, *found), phase


def _focus(logs: Sequence[Log], settings: RfidSettings, survey: SurveySettings) -> PhaseFit | None:
    """The focus by phases; None if there are too few phases near their tags."""
    try:
        return fit_phase(logs, settings, survey) if logs else None
    except InputError:
        return None


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
        strength = fit_rssi(logs, settings, survey).settings
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

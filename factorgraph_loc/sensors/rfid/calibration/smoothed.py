"""Detection models learnt from logs without a reference, along the trajectories that the smoother found.

The likelihood of the reads is averaged over the poses that the smoother thinks possible
(:func:`~factorgraph_loc.sensors.smoothed.possible_poses`). Tags that are probably not where the map has them are left out. A
beam is fitted in all its parameters, and a logistic model in all its coefficients; a grid keeps its shape, and changes as
estimators change it on the way (:mod:`factors.rfid.kernels`).
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.fitting.constants import FittedConstant
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.calibrating import Settled
from factorgraph_loc.sensors.rfid.calibration.fit import Floor
from factorgraph_loc.sensors.rfid.calibration.learn import CALIBRATED, floor_of, written
from factorgraph_loc.sensors.rfid.calibration.pairs import BLOCKS, TagPairs, modelled, pairs_of
from factorgraph_loc.sensors.rfid.calibration.refit import Refit, refit_beam, refit_logistic
from factorgraph_loc.sensors.rfid.calibration.rounds import Rounds, rounds_of
from factorgraph_loc.sensors.rfid.calibration.tempering import bursts
from factorgraph_loc.sensors.rfid.settings import PriorSettings, RfidSettings
from factorgraph_loc.sensors.smoothed import REFERENCE_GAP, Corrections, Smoothed, pooled, possible_poses
from factorgraph_loc.text import quoted
from factors.rfid.kernels import MOST_CERTAIN, PARAMETERS, rate_of
from factors.rfid.model import FEATURES, BeamModel, DetectionModel, GridModel, LogisticModel

MIN_READS = 100.0  # weighted reads that a model is learnt from
BURSTS = 1.3  # rounds that are worth one; less is no reason to change the tempering
VAGUE = 0.5  # relative standard error of a parameter that is not told
KEPT = "kept: learnt from reads and misses along the smoothed trajectories"


def relearn_rfid(smoothed: Sequence[Smoothed], rig: Rig, first: Rig, grids: Path) -> Settled:
    """The detection models of ``rig`` and their priors, from smoothed logs; see
    :meth:`~factorgraph_loc.sensors.calibrating.Calibrator.relearn`."""
    settings, started = rig.of(RfidSettings), first.of(RfidSettings)
    floor = floor_of(started)
    rounds = [_rounds(one, settings) for one in smoothed]
    pairs = pairs_of(rounds, settings, rig.survey)
    log = pairs.fold if len(rounds) > 1 else 2 * pairs.fold // BLOCKS  # the halves of a single one
    names, which = list(settings.models), [a.model for a in settings.all_antennas().values()]
    models, constants, notes = dict(settings.models), list[FittedConstant](), list[str]()
    parameters = settings.parameter_names()
    for name in parameters:
        mine = np.isin(pairs.antenna, [i for i, model in enumerate(which) if model == name])
        part = pairs.part(mine)
        if part.hits.sum() < MIN_READS:
            notes.append(
                f"The antennas of model {quoted(name)} read {part.hits.sum():.0f} tags, expected {MIN_READS:.0f}: it stays."
            )
            continue
        changes = {
            kind: [one.constants[f"rfid.{label}"] for one in smoothed if f"rfid.{label}" in one.constants]
            for kind, label in zip(PARAMETERS, parameters[name], strict=True)
        }
        told = {k: pooled(found, getattr(CALIBRATED, k)) for k, found in changes.items() if len(found) == len(smoothed)}
        model, before = settings.models[name].model(), started.models[name].model()
        if isinstance(model, GridModel):
            assert isinstance(before, GridModel)
            gridded, found = _grid(model, before, name, told)
            changed: DetectionModel = gridded
        else:
            fitted = _refit(model, part, floor)
            if np.any(fitted.errors > VAGUE * np.abs(fitted.values)) and isinstance(model, BeamModel):
                notes.append(f"The logs hardly tell the model {quoted(name)} of the antennas: it stays.")
                continue
            each = [_refit(model, pairs.part(mine & (log == i)), floor) for i in np.unique(log)]
            changed, found = fitted.model, _constants(fitted, each, before, name, told)
        constants += found
        spreads = {kind: min(one.spread, 1.0) for kind, one in told.items()}
        models[name] = written(changed, name, grids).model_copy(update={"prior": CALIBRATED.model_copy(update=spreads)})
    changed_models = [models[name].model() for name in names]
    together, error = bursts(pairs, modelled(changed_models, [names.index(name) for name in which], pairs), floor)
    constants.append(_tempering(together, error, started.tempering))
    return Settled(
        {
            "rfid": settings.model_copy(
                update={
                    "models": {name: models[name] for name in names},
                    "false_read": floor.false_read,
                    "miss": floor.miss,
                    "tempering": constants[-1].value,
                }
            )
        },
        constants,
        notes,
    )


def _tempering(together: float, error: float, before: float) -> FittedConstant:
    """The tempering for rounds of which so many are worth an independent one, if that is less than ``before``."""
    kept = together > BURSTS and together * before > 1.0
    return FittedConstant(
        "rfid",
        "tempering",
        before=before,
        fitted=1.0 / together,
        error=max(error / together**2, 1e-4),
        gain=0.0,
        kept=kept,
        why="kept: reads and misses come in bursts" if kept else "not kept: bursts ask for no lower one",
        per_log=(),
        uncertainty=None,
    )


def with_priors(settings: RfidSettings, first: RfidSettings) -> RfidSettings:
    """The settings with the priors that the models of the ``first`` ones have."""
    priors: dict[str, PriorSettings] = {name: model.prior for name, model in first.models.items()}
    models = {name: model.model_copy(update={"prior": priors[name]}) for name, model in settings.models.items()}
    return settings.model_copy(update={"models": models})


def _rounds(one: Smoothed, settings: RfidSettings) -> Rounds:
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


def _refit(model: DetectionModel, pairs: TagPairs, floor: Floor) -> Refit:
    if isinstance(model, BeamModel):
        return refit_beam(pairs, floor, model)
    return refit_logistic(pairs, floor, with_facing=model.uses_facing)


def _constants(
    fitted: Refit, each: Sequence[Refit], before: DetectionModel, name: str, told: dict[str, Corrections]
) -> list[FittedConstant]:
    """The parameters of a fitted model."""
    scatter: dict[str, float] = {}
    known: dict[str, float] = {}
    if isinstance(before, BeamModel) and isinstance(fitted.model, BeamModel):
        known = {key: getattr(before, key) for key in fitted.names}
        p0, r_max = fitted.model.p0, fitted.model.r_max
        units = {"p0": ("read_rate", p0 * (1.0 - p0)), "r_max": ("range_scale", r_max)}
        scatter = {key: unit * told[kind].spread for key, (kind, unit) in units.items() if kind in told}
    elif isinstance(before, LogisticModel):
        known = {f"coefficient of {label}": b for label, b in zip(FEATURES, before.coefficients, strict=True)}
    return [
        FittedConstant(
            "rfid",
            f"models.{name}.{key}",
            before=known.get(key, 0.0),
            fitted=float(value),
            error=float(error),
            gain=0.0,
            kept=True,
            why=KEPT,
            per_log=tuple(float(one.values[one.names.index(key)]) if key in one.names else 0.0 for one in each),
            uncertainty=scatter.get(key) if len(each) > 1 else None,
        )
        for key, value, error in zip(fitted.names, fitted.values, fitted.errors, strict=True)
    ]


def _grid(
    model: GridModel, before: GridModel, name: str, told: dict[str, Corrections]
) -> tuple[GridModel, list[FittedConstant]]:
    """A grid changed by the mean changes of its range and rate, and what they are since the grid ``before`` all turns."""
    scale, shift = (told[kind].mean if kind in told else 0.0 for kind in PARAMETERS)
    peak = min(model.peak, MOST_CERTAIN)
    p = rate_of(peak, shift) / (1.0 + np.exp(-model.logits))
    p = np.clip(p, 1e-6, 1.0 - 1e-6)
    factor = float(np.exp(scale))
    changed = replace(
        model, logits=np.log(p / (1.0 - p)), x0=factor * model.x0, y0=factor * model.y0, cell=factor * model.cell
    )
    totals = (
        float(np.log(changed.cell / before.cell)),
        _logit(min(changed.peak, MOST_CERTAIN)) - _logit(min(before.peak, MOST_CERTAIN)),
    )
    return changed, [
        FittedConstant(
            "rfid",
            f"models.{name}.{kind}",
            before=0.0,
            fitted=total,
            error=told[kind].error,
            gain=0.0,
            kept=True,
            why=KEPT,
            per_log=tuple((total - told[kind].mean + told[kind].each).tolist()),
            uncertainty=told[kind].spread if len(told[kind].each) > 1 else None,
        )
        for kind, total in zip(PARAMETERS, totals, strict=True)
        if kind in told
    ]


def _logit(p: float) -> float:
    return float(np.log(p / (1.0 - p)))

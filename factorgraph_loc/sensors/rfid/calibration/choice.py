"""Selection of the detection model with the best prediction of held-out data."""

from dataclasses import dataclass

import numpy as np

from factorgraph_loc.sensors.rfid.calibration.fit import Floor, fit_beam, fit_logistic
from factorgraph_loc.sensors.rfid.calibration.grid import Axes, fit_grid
from factorgraph_loc.sensors.rfid.calibration.pairs import TagPairs, modelled
from factors.rfid.model import DetectionModel
from factors.se2 import Array

SMOOTHNESS = (5.0, 25.0, 125.0)
WORTH = 1e-3  # nats per pair; minimum gain of a more complex model
BEAM_PAIRS = 20000  # enough for its four parameters


PLANE = Axes()


@dataclass(frozen=True)
class Kind:
    """A model to fit: ``name`` beam, logistic or grid; ``facing``: whether features use the tags' facing; ``own``: one model per
    antenna. ``axes`` and ``smoothness`` of a grid."""

    name: str
    facing: bool = False
    own: bool = False
    axes: Axes = PLANE
    smoothness: float = 0.0

    def label(self) -> str:
        """For tables."""
        words = [self.name]
        if self.name == "logistic":
            words.append("with facing" if self.facing else "without facing")
        if self.axes.by_height:
            words.append("by height")
        if self.axes.by_facing:
            words.append("by facing")
        return ", ".join([*words, "one an antenna" if self.own else "one for all"])


@dataclass(frozen=True)
class CrossValidation:
    """Held-out negative log-likelihood [nats per pair] of a model, per fold and over all; ``predicted`` (M,): probabilities of the
    pairs, floor included, from fits to the other folds."""

    kind: Kind
    by_fold: tuple[float, ...]
    nll: float
    predicted: Array


@dataclass(frozen=True)
class ModelSelection:
    """The ``best`` trial, and all ``trials``."""

    best: CrossValidation
    trials: tuple[CrossValidation, ...]

    @property
    def kind(self) -> Kind:
        return self.best.kind


def fit(pairs: TagPairs, kind: Kind, floor: Floor, antennas: int) -> tuple[tuple[DetectionModel, ...], tuple[int, ...]]:
    """The models, and the model index of each antenna. An antenna without rounds has the common model."""
    if not kind.own:
        return (_fit_one(pairs, kind, floor),), (0,) * antennas
    heard = [a for a in range(antennas) if np.any(pairs.antenna == a)]
    models = [_fit_one(pairs.part(pairs.antenna == a), kind, floor) for a in heard]
    if len(heard) < antennas:
        models.append(_fit_one(pairs, kind, floor))
    return tuple(models), tuple(heard.index(a) if a in heard else len(heard) for a in range(antennas))


def choose(pairs: TagPairs, floor: Floor, antennas: int, *, facing: bool) -> ModelSelection:
    """Select the model by its likelihood on held-out folds of ``pairs``.

    A more complex model must gain :data:`WORTH` over a simpler one. ``facing``: whether the tags' facing is known.
    """
    trials: list[CrossValidation] = []

    def tried(kind: Kind) -> CrossValidation:
        trials.append(_trial(pairs, kind, floor, antennas))
        return trials[-1]

    def better(best: CrossValidation, kind: Kind) -> CrossValidation:
        trial = tried(kind)
        return trial if trial.nll < best.nll - WORTH else best

    best = tried(Kind("beam"))
    best = better(best, Kind("logistic"))
    if facing:
        best = better(best, Kind("logistic", facing=True))
    uses_facing = best.kind.facing
    if antennas > 1:
        best = better(best, Kind("logistic", facing=uses_facing, own=True))
    fields = [tried(Kind("grid", uses_facing, smoothness=s)) for s in SMOOTHNESS]
    field = min(fields, key=lambda t: t.nll)
    smoothness = field.kind.smoothness
    if uses_facing:
        field = better(field, Kind("grid", True, axes=Axes(by_facing=True), smoothness=smoothness))
    if np.ptp(np.quantile(pairs.points[:, 2], (0.02, 0.98))) > 0.5:
        field = better(field, Kind("grid", uses_facing, axes=Axes(by_height=True), smoothness=smoothness))
    if field.nll < best.nll - WORTH:
        best = field
    return ModelSelection(best, tuple(trials))


def held_out(pairs: TagPairs, kind: Kind, floor: Floor, antennas: int) -> Array:
    """Probability (M,) of a read, floor included, for each fold from a fit to the others."""
    out = np.empty(len(pairs.facing))
    for fold in np.unique(pairs.fold):
        test = pairs.fold == fold
        models, which = fit(pairs.part(~test), kind, floor, antennas)
        logit = modelled(models, which, pairs.part(test))
        out[test] = floor.false_read + (1.0 - floor.false_read - floor.miss) / (1.0 + np.exp(-logit))
    return out


def _fit_one(pairs: TagPairs, kind: Kind, floor: Floor) -> DetectionModel:
    if kind.name == "beam":
        return fit_beam(pairs.part(np.arange(len(pairs.facing)) % (1 + len(pairs.facing) // BEAM_PAIRS) == 0), floor)
    parametric = fit_logistic(pairs, floor, with_facing=kind.facing)
    return parametric if kind.name == "logistic" else fit_grid(pairs, parametric, kind.smoothness, kind.axes, floor)


def _trial(pairs: TagPairs, kind: Kind, floor: Floor, antennas: int) -> CrossValidation:
    q = held_out(pairs, kind, floor, antennas)
    nll = -(pairs.hits * np.log(q) + (pairs.count - pairs.hits) * np.log1p(-q))
    folds = [pairs.fold == fold for fold in np.unique(pairs.fold)]
    each = tuple(float(np.sum(nll[one]) / np.sum(pairs.count[one])) for one in folds)
    return CrossValidation(kind, each, float(np.sum(nll) / np.sum(pairs.count)), q)

"""Trajectories along which sensors are calibrated: those of references, or of an estimator that has smoothed logs without any.

Each smoothed log has constants of its own, which scatter about those of the installation. An estimator finds each as a correction
of the rig's value, with a standard deviation. Their mean over the logs becomes the rig's value, and their scatter its uncertainty
(empirical Bayes: Efron and Morris, "Data analysis using Stein's estimator and its generalizations", JASA 70, 1975).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgraph_loc.fitting.posterior import FittedConstant
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factors.se2 import Array

WORTH = 2.0  # logs that the uncertainty of the input rig counts as: few logs tell little of a scatter
REFERENCE_GAP = 0.35  # s; longest interpolated gap between reference poses


@dataclass(frozen=True)
class Traced:
    """A log with the trajectory along which is learnt, as its reference.

    ``constants``: None for a reference proper. For a smoothed trajectory, which has covariances, the constants that were estimated,
    by their names in :class:`~factorgraph_loc.model.belief.Learnt`, each the correction of the rig's value with its standard
    deviation. ``doubted``: names of things that are probably not where the map has them.
    """

    log: Log
    constants: Mapping[str, tuple[float, float]] | None = None
    doubted: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Corrections:
    """Corrections ``each`` (N,) of one constant in N logs: their ``mean``, and ``spread``, the standard deviation between logs."""

    each: Array
    mean: float
    spread: float

    @property
    def error(self) -> float:
        """Standard error of the mean."""
        return self.spread / float(np.sqrt(len(self.each)))


def pooled(found: Sequence[tuple[float, float]], known: float) -> Corrections:
    """The mean and the scatter of corrections, each with a standard deviation; ``known``: the scatter that is known before.

    The scatter is that of the corrections less what their own errors explain, by moments; with what was known before it is
    averaged as if that came from :data:`WORTH` logs. The mean has the errors of the corrections in its own.
    """
    each, errors = np.array(found).T
    beyond = float(np.sum((each - each.mean()) ** 2) - (len(each) - 1) * np.mean(errors**2))
    variance = (WORTH * known**2 + max(beyond, 0.0)) / (WORTH + len(each) - 1)
    return Corrections(each, float(each.mean()), float(np.sqrt(variance)))


def pooled_constants(
    section: str, prefix: str, settings: Any, first: Any, names: Mapping[str, float], smoothed: Sequence[Traced]
) -> tuple[Any, list[FittedConstant]]:
    """The ``settings`` of a section with those of its constants ``names`` (with upper bounds of their uncertainties) that were
    estimated in all logs, and what was found. ``first``: the settings before anything was learnt.

    Scales are corrected by factors, others by sums. The uncertainty is written if there are several logs.
    """
    values: dict[str, float] = {}
    uncertainties: dict[str, float] = {}
    out = []
    for name, most in names.items():
        told = [one.constants or {} for one in smoothed]
        found = [constants[prefix + name] for constants in told if prefix + name in constants]
        if len(found) < len(smoothed):
            continue
        before, now = float(getattr(first, name)), float(getattr(settings, name))
        unit, unit_now = (before, now) if "scale" in name else (1.0, 1.0)
        changes = [((now + unit_now * c - before) / unit, s) for c, s in found]
        result = pooled(changes, float(getattr(first.uncertainty, name)))
        values[name] = before + unit * result.mean
        if len(found) > 1:
            uncertainties[name] = min(result.spread, most)
        out.append(
            FittedConstant(
                section,
                name,
                before=before,
                fitted=values[name],
                error=abs(unit) * result.error,
                per_log=tuple((before + unit * result.each).tolist()),
                uncertainty=uncertainties.get(name),
            )
        )
    uncertainty = first.uncertainty.model_copy(update=uncertainties)
    return settings.model_copy(update=values | {"uncertainty": uncertainty}), out


def possible_poses(trajectory: Trajectory, t: Array, max_gap: float) -> Array:
    """A pose (N, 3) at each time (N,) of a trajectory with covariances, drawn from the six cubature points of its distribution:
    so means over many times are also means over what the trajectory leaves open. NaN outside and in gaps longer than ``max_gap``.

    Cubature: Arasaratnam and Haykin, "Cubature Kalman filters", IEEE TAC 54(6), 2009. Always the same draws.
    """
    poses = trajectory.at(t, max_gap=max_gap)
    covariances = np.nan_to_num(trajectory.covariances_at(t, max_gap=max_gap)) + 1e-12 * np.eye(3)
    rng = np.random.default_rng(0)
    axis, sign = rng.integers(0, 3, len(t)), rng.choice((-1.0, 1.0), len(t))
    root = np.linalg.cholesky(covariances)[np.arange(len(t)), :, axis]
    return np.asarray(poses + np.sqrt(3.0) * sign[:, None] * root)

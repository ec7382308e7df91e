"""Trajectories for the calibration of sensors: reference trajectories, or smoothed ones in logs without a reference.

In a log without reference, the smoother also estimates corrections of the calibration constants in the rig. The mean
correction over all logs updates a constant. The scatter between logs is the new uncertainty of the constant. Source
(empirical Bayes): Efron, Morris, "Data analysis using Stein's estimator and its generalizations", JASA 70, 1975.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgraph_loc.fitting.posterior import FittedConstant
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.registry import moving
from factors.se2 import Array

WORTH = 2.0  # weight of the uncertainty in the input rig, as a number of logs
REFERENCE_GAP = 0.35  # s; longest interpolated gap between reference poses


@dataclass(frozen=True)
class Traced:
    """A log for calibration. Its reference is a measured trajectory or one that a smoother estimated.

    ``constants``: None for a measured trajectory. For a smoothed one: the estimated correction of each constant of the
    rig and its standard deviation, by the name in :class:`~factorgraph_loc.model.belief.Learnt`. ``doubted``: names of
    tags or landmarks that are probably not at their position in the map.
    """

    log: Log
    constants: Mapping[str, tuple[float, float]] | None = None
    doubted: frozenset[str] = frozenset()


def recordings(logs: Sequence[Log]) -> list[int]:
    """Return for each log the index of the first log of the same recording. Logs belong to the same recording if they
    differ only in their odometry."""
    keys = [_exteroceptive(log) or i for i, log in enumerate(logs)]
    return [keys.index(key) for key in keys]


def _exteroceptive(log: Log) -> bytes:
    """Return the bytes of all arrays of a log's streams, except streams that measure motion."""
    streams = [log.streams[name] for name in sorted(set(log.streams) - set(moving(log.streams)))]
    arrays = [array for stream in streams for array in vars(stream).values() if isinstance(array, np.ndarray)]
    return b"".join(array.tobytes() for array in arrays)


@dataclass(frozen=True)
class Corrections:
    """Corrections ``each`` (N,) of a constant in N logs, their ``mean``, and their standard deviation ``scatter``."""

    each: Array
    mean: float
    scatter: float

    @property
    def error(self) -> float:
        """The standard error of ``mean``."""
        return self.scatter / float(np.sqrt(len(self.each)))


def pooled(corrections: Sequence[tuple[float, float]], known: float) -> Corrections:
    """Return the mean of corrections of a constant over N logs, and the scatter between logs without estimation errors.

    ``corrections``: N pairs of a correction and its standard deviation. ``known``: the standard deviation of the
    constant in the input rig. The returned scatter is an average with ``known``, which has the weight of :data:`WORTH`
    logs.
    """
    each, errors = np.array(corrections).T
    beyond = float(np.sum((each - each.mean()) ** 2) - (len(each) - 1) * np.mean(errors**2))
    variance = (WORTH * known**2 + max(beyond, 0.0)) / (WORTH + len(each) - 1)
    return Corrections(each, float(each.mean()), float(np.sqrt(variance)))


def corrections_of(name: str, traced: Sequence[Traced]) -> list[tuple[float, float]]:
    """Return a pair for each log: the estimated correction of the constant ``name``, and its standard deviation.
    Returns [] if a log lacks an estimate of the constant."""
    corrections = [trace.constants[name] for trace in traced if trace.constants and name in trace.constants]
    return corrections if len(corrections) == len(traced) else []


def pooled_constants(
    section: str, prefix: str, settings: Any, first: Any, traced: Sequence[Traced]
) -> tuple[Any, list[FittedConstant]]:
    """Return the settings of the ``section`` of a sensor with updated constants, and a list of the constants that
    changed.

    Constants that were estimated in all logs get the mean of the estimates. With several logs, their uncertainties are
    updated too. ``prefix``: the prefix of the constants' names in ``Traced.constants``. ``settings``: the settings with
    which the logs were smoothed. ``first``: the settings before the first iteration of smoothing and calibration.
    """
    values: dict[str, float] = {}
    uncertainties: dict[str, float] = {}
    out = []
    for name in type(first.uncertainty).model_fields:
        if not (corrections := corrections_of(prefix + name, traced)):
            continue
        initial, current = float(getattr(first, name)), float(getattr(settings, name))
        unit, current_unit = (initial, current) if "scale" in name else (1.0, 1.0)
        changes = [((current + current_unit * c - initial) / unit, s) for c, s in corrections]
        result = pooled(changes, float(getattr(first.uncertainty, name)))
        values[name] = initial + unit * result.mean
        if len(changes) > 1:
            uncertainties[name] = result.scatter
        each = tuple((initial + unit * result.each).tolist())
        error, uncertainty = abs(unit) * result.error, uncertainties.get(name)
        out.append(FittedConstant(section, name, initial, values[name], error, None, each, uncertainty))
    uncertainty = first.uncertainty.model_copy(update=uncertainties)
    return settings.model_copy(update=values | {"uncertainty": uncertainty}), out


def possible_poses(trajectory: Trajectory, t: Array) -> Array:
    """Return one random pose (N, 3) at each time ``t`` (N,) [s] of a trajectory with covariances.

    Each pose is one of the six cubature points of its Gaussian, chosen with a fixed seed. It is NaN in gaps longer than
    :data:`REFERENCE_GAP`. Source: Arasaratnam, Haykin, "Cubature Kalman filters", IEEE TAC 54(6), 2009.
    """
    poses = trajectory.at(t, max_gap=REFERENCE_GAP)
    covariances = np.nan_to_num(trajectory.covariances_at(t, max_gap=REFERENCE_GAP)) + 1e-12 * np.eye(3)
    rng = np.random.default_rng(0)
    axis, sign = rng.integers(0, 3, len(t)), rng.choice((-1.0, 1.0), len(t))
    root = np.linalg.cholesky(covariances)[np.arange(len(t)), :, axis]
    return np.asarray(poses + np.sqrt(3.0) * sign[:, None] * root)

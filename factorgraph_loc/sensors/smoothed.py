"""Trajectories for the calibration of sensors: references, or trajectories that a smoother estimated in logs without reference.

In each log the smoother estimates the sensors' constants as corrections of the rig's values, with standard deviations. The mean
of a correction over the logs updates the rig's value. The scatter of a correction between logs is the uncertainty of the
constant (empirical Bayes: Efron and Morris, "Data analysis using Stein's estimator and its generalizations", JASA 70, 1975).
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

WORTH = 2.0  # the uncertainty of the input rig has the weight of this many logs, because the scatter of few logs is uncertain
REFERENCE_GAP = 0.35  # s; longest interpolated gap between reference poses


@dataclass(frozen=True)
class Traced:
    """A log for calibration, whose reference is a measured or a smoothed trajectory.

    ``constants``: None for a measured reference. For a smoothed trajectory: the estimated constants by their names in
    :class:`~factorgraph_loc.model.belief.Learnt`. Each value is a correction of the rig's value, and its standard
    deviation. ``doubted``: names of elements that are probably not at their position in the map.
    """

    log: Log
    constants: Mapping[str, tuple[float, float]] | None = None
    doubted: frozenset[str] = frozenset()


def recordings(logs: Sequence[Log]) -> list[int]:
    """Return the number of the recording that each log belongs to, which is the index of its first log. Logs that
    differ only in their odometry belong to the same recording, because they are not independent."""
    keys = [_exteroceptive(log) or i for i, log in enumerate(logs)]
    return [keys.index(key) for key in keys]


def _exteroceptive(log: Log) -> bytes:
    """Return the bytes of all arrays of a log's streams, except streams that measure motion."""
    streams = [log.streams[name] for name in sorted(set(log.streams) - set(moving(log.streams)))]
    arrays = [array for stream in streams for array in vars(stream).values() if isinstance(array, np.ndarray)]
    return b"".join(array.tobytes() for array in arrays)


@dataclass(frozen=True)
class Corrections:
    """Corrections of one constant in N logs: ``each`` (N,), their ``mean``, and their standard deviation ``scatter``."""

    each: Array
    mean: float
    scatter: float

    @property
    def error(self) -> float:
        """The standard error of the mean."""
        return self.scatter / float(np.sqrt(len(self.each)))


def pooled(corrections: Sequence[tuple[float, float]], known: float) -> Corrections:
    """Return mean and scatter of ``corrections``, each given with its standard deviation.

    The variance between logs is the variance of the corrections minus the part that their own errors explain. It is averaged
    with the square of ``known``, the standard deviation in the input rig, which has the weight of :data:`WORTH` logs.
    """
    each, errors = np.array(corrections).T
    beyond = float(np.sum((each - each.mean()) ** 2) - (len(each) - 1) * np.mean(errors**2))
    variance = (WORTH * known**2 + max(beyond, 0.0)) / (WORTH + len(each) - 1)
    return Corrections(each, float(each.mean()), float(np.sqrt(variance)))


def corrections_of(name: str, traced: Sequence[Traced]) -> list[tuple[float, float]]:
    """Return the correction of a constant and its standard deviation in each log. Returns [] if it was not estimated in
    all logs."""
    corrections = [trace.constants[name] for trace in traced if trace.constants and name in trace.constants]
    return corrections if len(corrections) == len(traced) else []


def pooled_constants(
    section: str, prefix: str, settings: Any, first: Any, traced: Sequence[Traced]
) -> tuple[Any, list[FittedConstant]]:
    """Update the constants of a section that were estimated in all logs. Returns the new settings and the fitted constants.

    ``prefix``: the prefix of the constants' names in the logs. ``settings``: the settings that the logs were smoothed
    with. ``first``: the settings before the first repetition of smoothing and calibration. Corrections of scales are
    relative, others are absolute. With several logs, the uncertainties of the constants are updated as well.
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

    Each pose is drawn from the six cubature points of the pose's distribution. A mean over many times is therefore also a mean
    over the errors of the trajectory. Poses are NaN outside of the trajectory and in gaps longer than :data:`REFERENCE_GAP`.
    The random draws are the same at each call. Source: Arasaratnam and Haykin, "Cubature Kalman filters", IEEE TAC 54(6), 2009.
    """
    poses = trajectory.at(t, max_gap=REFERENCE_GAP)
    covariances = np.nan_to_num(trajectory.covariances_at(t, max_gap=REFERENCE_GAP)) + 1e-12 * np.eye(3)
    rng = np.random.default_rng(0)
    axis, sign = rng.integers(0, 3, len(t)), rng.choice((-1.0, 1.0), len(t))
    root = np.linalg.cholesky(covariances)[np.arange(len(t)), :, axis]
    return np.asarray(poses + np.sqrt(3.0) * sign[:, None] * root)

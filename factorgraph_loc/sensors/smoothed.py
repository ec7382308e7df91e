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
from factorgraph_loc.sensors.registry import moving
from factors.se2 import Array

WORTH = 2.0  # logs that the uncertainty of the input rig counts as: the scatter of few logs is uncertain
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


def recordings(logs: Sequence[Log]) -> list[int]:
    """The number of the recording of each log. Logs that differ in their odometry only are not independent: they are one."""
    keys = [_exteroceptive(log) or i for i, log in enumerate(logs)]
    return [keys.index(key) for key in keys]


def _exteroceptive(log: Log) -> bytes:
    """The arrays of all streams but those of the motion."""
    streams = [log.streams[name] for name in sorted(set(log.streams) - set(moving(log.streams)))]
    arrays = [array for stream in streams for array in vars(stream).values() if isinstance(array, np.ndarray)]
    return b"".join(array.tobytes() for array in arrays)


@dataclass(frozen=True)
class Corrections:
    """Corrections ``each`` (N,) of one constant in N logs: their ``mean``, and their ``scatter`` (standard deviation)."""

    each: Array
    mean: float
    scatter: float

    @property
    def error(self) -> float:
        """Standard error of the mean."""
        return self.scatter / float(np.sqrt(len(self.each)))


def pooled(corrections: Sequence[tuple[float, float]], known: float) -> Corrections:
    """The mean and the scatter of corrections, each with a standard deviation; ``known``: the scatter according to the input rig.

    The scatter is that of the corrections, less the part that their own errors explain, by moments. The known scatter is averaged
    with it as if it came from :data:`WORTH` logs. The scatter of the corrections includes the errors of the mean.
    """
    each, errors = np.array(corrections).T
    beyond = float(np.sum((each - each.mean()) ** 2) - (len(each) - 1) * np.mean(errors**2))
    variance = (WORTH * known**2 + max(beyond, 0.0)) / (WORTH + len(each) - 1)
    return Corrections(each, float(each.mean()), float(np.sqrt(variance)))


def corrections_of(name: str, traced: Sequence[Traced]) -> list[tuple[float, float]]:
    """The correction of a constant in each log, with its standard deviation; empty if it was not estimated in all logs."""
    corrections = [trace.constants[name] for trace in traced if trace.constants and name in trace.constants]
    return corrections if len(corrections) == len(traced) else []


def pooled_constants(
    section: str, prefix: str, settings: Any, first: Any, traced: Sequence[Traced]
) -> tuple[Any, list[FittedConstant]]:
    """The ``settings`` of a section with those of its uncertain constants that were estimated in all logs, and these constants.
    ``first``: the settings before anything was learnt.

    Scales are corrected by factors, others by sums. The uncertainty is written if there are several logs.
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
    """A pose (N, 3) at each time (N,) of a trajectory with covariances, drawn from the six cubature points of its distribution:
    so means over many times are also means over what the trajectory leaves open. NaN outside and in gaps longer than
    :data:`REFERENCE_GAP`.

    Cubature: Arasaratnam and Haykin, "Cubature Kalman filters", IEEE TAC 54(6), 2009. Always the same draws.
    """
    poses = trajectory.at(t, max_gap=REFERENCE_GAP)
    covariances = np.nan_to_num(trajectory.covariances_at(t, max_gap=REFERENCE_GAP)) + 1e-12 * np.eye(3)
    rng = np.random.default_rng(0)
    axis, sign = rng.integers(0, 3, len(t)), rng.choice((-1.0, 1.0), len(t))
    root = np.linalg.cholesky(covariances)[np.arange(len(t)), :, axis]
    return np.asarray(poses + np.sqrt(3.0) * sign[:, None] * root)

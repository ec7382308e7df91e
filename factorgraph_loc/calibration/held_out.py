"""Held-out stretches of logs, on which an estimator judges what was learnt from the rest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.calibration.learn import calibrators
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log, cut
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.calibrating import Calibrator
from factorgraph_loc.sensors.odometry.calibration import odometry_of

QUARTERS = 4  # stretches that a log is divided into
WARM_UP = 2.0  # s of odometry before a stretch, for the delay of commands
LONGEST = 75.0  # s, the longest stretch that is run, about the middle of a held-out part
FEWEST_POSES = 20  # poses of the reference that a stretch needs


@dataclass(frozen=True)
class Fold:
    """A split of the logs: ``train`` to learn from, ``tests`` held out; ``part``: the recordings that ``tests`` belong to."""

    part: int
    train: tuple[Log, ...]
    tests: tuple[Log, ...]


def recordings(logs: Sequence[Log]) -> list[int]:
    """The number of the recording behind each log: logs with the same measurements are not independent."""
    found = [one.recordings(logs) for one in _sensing(logs)]
    return next((numbers for numbers in found if len(set(numbers)) < len(logs)), list(range(len(logs))))


def _sensing(logs: Sequence[Log]) -> list[Calibrator]:
    return [one for one in calibrators().values() if one.channel in logs[0].streams]


def folds_of(logs: Sequence[Log]) -> tuple[Fold, ...]:
    """Folds over the recordings. A single recording is split in quarters, or in fewer and larger parts of several stretches
    each where a sensor's models take long to fit.
    """
    parts = recordings(logs)
    if len(set(parts)) > 1:
        out = []
        for part in dict.fromkeys(parts):
            train = tuple(log for log, p in zip(logs, parts, strict=True) if p != part)
            own = [log for log, p in zip(logs, parts, strict=True) if p == part]
            out.append(Fold(part, train, tuple(test for log in own for test in _stretches(log, 0.0, 1.0, QUARTERS))))
        return tuple(out)
    count, each = min(one.folds for one in _sensing(logs))
    shares = [(k / count, (k + 1) / count) for k in range(count)]
    return tuple(
        Fold(
            0,
            tuple(_silenced(log, a, b) for log in logs),
            tuple(test for log in logs for test in _stretches(log, a, b, each)),
        )
        for a, b in shares
    )


def _bounds(log: Log) -> tuple[float, float]:
    """The interval [s] in which the log has both odometry and reference."""
    assert log.reference is not None
    t = odometry_of(log).t + log.rig.time_offset("odometry")
    return max(float(t[0]), float(log.reference.t[0])), min(float(t[-1]), float(log.reference.t[-1]))


def _silenced(log: Log, begin: float, end: float) -> Log:
    """The log without its reference between two fractions of its duration."""
    assert log.reference is not None
    first, last = _bounds(log)
    share = (log.reference.t - first) / max(last - first, 1e-9)
    keep = (share < begin) | (share >= end)
    return replace(log, reference=_kept(log.reference, keep))


def _kept(reference: Trajectory, keep: NDArray[np.bool_]) -> Trajectory:
    covariances = None if reference.covariances is None else reference.covariances[keep]
    return replace(reference, t=reference.t[keep], poses=reference.poses[keep], covariances=covariances)


def _stretches(log: Log, begin: float, end: float, count: int) -> list[Log]:
    """``count`` stretches of a log between two fractions of its duration, without those that lack reference or measurements."""
    first, last = _bounds(log)
    edges = first + (last - first) * np.linspace(begin, end, count + 1)
    out = []
    for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        margin = max(0.0, 0.5 * (b - a - LONGEST))
        try:
            part = cut(log, a + margin - WARM_UP, b - margin)
        except InputError:  # no measurements there
            continue
        reference = part.reference
        if reference is None or not len(odometry_of(part).t):
            continue
        keep = reference.t >= a + margin
        if keep.sum() >= FEWEST_POSES:
            out.append(replace(part, reference=_kept(reference, keep)))
    return out

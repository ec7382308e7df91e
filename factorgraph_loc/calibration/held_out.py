"""Stretches of logs on which an estimator judges what was learnt from the rest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.calibration.learn import calibrators
from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log, cut
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.calibrating import Calibrator
from factorgraph_loc.sensors.odometry.calibration.windows import odometry_of

QUARTERS = 4  # that a log has
WARM_UP = 2.0  # s of odometry before a stretch: commands act late
LONGEST = 75.0  # s of a stretch that an estimator runs on, from its middle: longer logs do not take longer
FEWEST_POSES = 20  # of the reference in a stretch


@dataclass(frozen=True)
class Fold:
    """``train``: what is learnt from, ``tests``: stretches that have no part in it. ``part``: of which recording these are."""

    part: int
    train: tuple[Log, ...]
    tests: tuple[Log, ...]


def recordings(logs: Sequence[Log]) -> list[int]:
    """The number of what each log recorded: of logs that hold the same measurements one is no test of the other."""
    found = [one.recordings(logs) for one in _sensing(logs)]
    return next((numbers for numbers in found if len(set(numbers)) < len(logs)), list(range(len(logs))))


def _sensing(logs: Sequence[Log]) -> list[Calibrator]:
    return [one for one in calibrators().values() if one.channel in logs[0].streams]


def folds_of(logs: Sequence[Log]) -> tuple[Fold, ...]:
    """Each recording is judged with what the others tell. Of a single one each quarter with what the other quarters tell, or fewer
    and larger parts, in several stretches, where a sensor's models take long to fit."""
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
    """From when to when the log has both odometry and reference [s]."""
    assert log.reference is not None
    t = odometry_of(log).t + log.rig.time_offset("odometry")
    return max(float(t[0]), float(log.reference.t[0])), min(float(t[-1]), float(log.reference.t[-1]))


def _silenced(log: Log, begin: float, end: float) -> Log:
    """The log without the reference between two shares of its time: nothing is learnt there."""
    assert log.reference is not None
    first, last = _bounds(log)
    share = (log.reference.t - first) / max(last - first, 1e-9)
    keep = (share < begin) | (share >= end)
    return replace(log, reference=_kept(log.reference, keep))


def _kept(reference: Trajectory, keep: NDArray[np.bool_]) -> Trajectory:
    covariances = None if reference.covariances is None else reference.covariances[keep]
    return replace(reference, t=reference.t[keep], poses=reference.poses[keep], covariances=covariances)


def _stretches(log: Log, begin: float, end: float, count: int) -> list[Log]:
    """``count`` stretches of a log between two shares of its time; those without reference or measurements are left out."""
    first, last = _bounds(log)
    edges = first + (last - first) * np.linspace(begin, end, count + 1)
    out = []
    for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        margin = max(0.0, 0.5 * (b - a - LONGEST))
        try:
            part = cut(log, a + margin - WARM_UP, b - margin)
        except InputError:  # nothing was measured there
            continue
        reference = part.reference
        if reference is None or not len(odometry_of(part).t):
            continue
        keep = reference.t >= a + margin
        if keep.sum() >= FEWEST_POSES:
            out.append(replace(part, reference=_kept(reference, keep)))
    return out

"""The trajectories and errors of runs in a report, and their background: map and reference of the log.

Poses are thinned out and rounded to limit the size of the page.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from factorgraph_loc.evaluation.inference import independent_count
from factorgraph_loc.evaluation.pairing import pauses
from factorgraph_loc.io.results import Estimates
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.interfaces import Marks, marks
from factors.se2 import Array

LEVELS = np.linspace(0.0, 1.0, 51)  # probabilities of the quantiles of errors
_POSES = 1500  # maximum number of poses of the reference
_POINTS = 1500  # maximum number of points of a map of points

Place = tuple[float, float]


class Scene(BaseModel, frozen=True, allow_inf_nan=False):
    """Map and reference of a log in the world frame [m], for plots in a page. ``walls``: endpoints x1, y1, x2, y2.

    ``layers``: by layer of the map, such as landmarks or tags, the positions of its objects. ``reference``: positions
    in pieces, which are divided at long gaps. ``t0_ns``: timestamp of the log's start.
    """

    walls: list[tuple[float, float, float, float]]
    layers: dict[str, list[Place]]
    reference: list[list[Place]]
    t0_ns: int = Field(0, ge=-(2**63), lt=2**63)

    @classmethod
    def of(cls, log: Log) -> Scene:
        """Return the scene of a log, rounded to a millimetre. Objects are at the positions that estimators use."""
        return cls(
            walls=_plain(np.array(log.world.walls, dtype=float).reshape(-1, 4)),
            layers={layer.layer: _plain(_thinned(layer)) for layer in marks(log)},
            reference=[_plain(piece) for piece in _pieces(log)],
            t0_ns=log.t0_ns,
        )


def _thinned(layer: Marks) -> Array:
    places = layer.positions[:, :2]
    return places[:: len(places) // _POINTS + 1] if layer.dense else places


def _pieces(log: Log) -> tuple[Array, ...]:
    if log.reference is None or not len(log.reference):
        return ()
    t, places = log.reference.t, log.reference.poses[:, :2]
    step = len(t) // _POSES + 1
    return tuple(
        piece[np.unique(np.append(np.arange(0, len(piece), step), len(piece) - 1))]
        for piece in np.split(places, pauses(t))
    )


def _plain(values: Array) -> list[Any]:
    return [tuple(round(v, 3) for v in row) for row in values.tolist()]


def sigma(estimates: Estimates) -> Array:
    """Return twice the standard deviation (N,) [m] of each position, along the direction with the largest
    uncertainty."""
    assert estimates.trajectory.covariances is not None
    xx, xy, yy = (estimates.trajectory.covariances[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    with np.errstate(invalid="ignore"):
        return np.asarray(2.0 * np.sqrt((xx + yy) / 2.0 + np.sqrt(np.square((xx - yy) / 2.0) + np.square(xy))))


def thinned(estimates: Estimates, count: int) -> dict[str, list[float | None]]:
    """Return about ``count`` selected poses of a trajectory, as lists of rounded numbers. Unknown numbers are None.

    The lists are ``t`` [s], ``x``, ``y`` [m], ``e`` (position error [m]) and ``s`` (:func:`sigma` [m]). The trajectory
    is divided into intervals, and the poses with the smallest and the largest error of each interval are selected.
    """
    error, trajectory = estimates.errors["error_position"], estimates.trajectory
    x, y, _ = trajectory.poses.T
    keep = _thinned_rows(error, count)
    columns = {"t": trajectory.t, "x": x, "y": y, "e": error, "s": sigma(estimates)}
    return {
        name: [round(v, 3) if math.isfinite(v) else None for v in values[keep].tolist()]
        for name, values in columns.items()
    }


def quantiles(errors: Sequence[Array]) -> Array:
    """Return quantiles (51,) of the pooled errors of several runs, from minimum to maximum. Empty without errors."""
    known = _known(np.concatenate(errors)) if errors else np.empty(0)
    return np.quantile(known, LEVELS) if len(known) else known


def consistency(estimates: Estimates) -> tuple[float, float, int] | None:
    """Return the mean NEES of a trajectory, its effective number of independent values, and the degrees of freedom.

    Return None if fewer than two NEES are known.
    """
    nees = _known(estimates.errors["nees"])
    dof = 3 if len(_known(estimates.errors["error_heading"])) else 2
    return (float(np.mean(nees)), independent_count(nees), dof) if len(nees) > 1 else None


def _known(values: Array) -> Array:
    return np.asarray(values[np.isfinite(values)])


def _thinned_rows(error: Array, count: int) -> NDArray[np.int64]:
    """Return the indices of about ``count`` selected poses of N. They include the first and the last pose.

    The other poses have the smallest or the largest ``error`` (N,) of one of several intervals. In an interval without
    known errors, one pose is selected.
    """
    if len(error) <= count:
        return np.arange(len(error))
    size = -(-2 * len(error) // count)
    padded = np.pad(error, (0, -len(error) % size), constant_values=math.nan).reshape(-1, size)
    known = np.isfinite(padded)
    least = np.argmin(np.where(known, padded, math.inf), axis=1)
    largest = np.argmax(np.where(known, padded, -math.inf), axis=1)
    starts = np.arange(0, len(error), size)
    return np.unique(np.concatenate((starts + least, starts + largest, [0, len(error) - 1])))

"""Trajectories and errors of runs, decimated and rounded to limit the size of the page."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.evaluation.inference import independent_count
from factorgraph_loc.io.results import Estimates
from factors.se2 import Array

LEVELS = np.linspace(0.0, 1.0, 51)  # of the plotted distribution of errors


def sigma(estimates: Estimates) -> Array:
    """Twice the standard deviation (N,) [m] in the least certain direction."""
    assert estimates.trajectory.covariances is not None
    xx, xy, yy = (estimates.trajectory.covariances[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    with np.errstate(invalid="ignore"):
        return np.asarray(2.0 * np.sqrt((xx + yy) / 2.0 + np.sqrt(np.square((xx - yy) / 2.0) + np.square(xy))))


def thinned(estimates: Estimates, count: int) -> dict[str, list[float | None]]:
    """About ``count`` poses as plain values, to a millimetre and a millisecond; None where unknown.

    ``t``, ``x``, ``y``, ``e`` (position error) and ``s`` (sigma). Of each interval of time there are the poses with the smallest
    and with the largest error.
    """
    error, trajectory = estimates.errors["error_position"], estimates.trajectory
    x, y, _ = trajectory.poses.T
    keep = _thin(error, count)
    columns = {"t": trajectory.t, "x": x, "y": y, "e": error, "s": sigma(estimates)}
    return {
        name: [round(v, 3) if math.isfinite(v) else None for v in values[keep].tolist()]
        for name, values in columns.items()
    }


def quantiles(errors: Sequence[Array]) -> Array:
    """Quantiles of the pooled errors of several runs at ``LEVELS``; empty without any error."""
    known = _known(np.concatenate(errors)) if errors else np.empty(0)
    return np.quantile(known, LEVELS) if len(known) else known


def consistency(estimates: Estimates) -> tuple[float, float, int] | None:
    """Mean NEES per degree of freedom, its effective number of independent values, and the degrees of freedom; None without any."""
    nees = _known(estimates.errors["nees"])
    dof = 3 if len(_known(estimates.errors["error_heading"])) else 2
    return (float(np.mean(nees)) / dof, independent_count(nees), dof) if len(nees) > 1 else None


def _known(values: Array) -> Array:
    return np.asarray(values[np.isfinite(values)])


def _thin(error: Array, count: int) -> NDArray[np.int64]:
    """About ``count`` indices of N, including the first and the last; evenly spread where no error is known."""
    if len(error) <= count:
        return np.arange(len(error))
    size = -(-2 * len(error) // count)
    padded = np.pad(error, (0, -len(error) % size), constant_values=math.nan).reshape(-1, size)
    known = np.isfinite(padded)
    least = np.argmin(np.where(known, padded, math.inf), axis=1)
    largest = np.argmax(np.where(known, padded, -math.inf), axis=1)
    starts = np.arange(0, len(error), size)
    return np.unique(np.concatenate((starts + least, starts + largest, [0, len(error) - 1])))

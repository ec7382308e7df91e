"""Trajectories and errors of runs, decimated and rounded to limit the size of the page."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from factorgraph_loc.evaluation.inference import independent_count
from factorgraph_loc.io.results import ESTIMATES, by_kind, parse_estimates
from factors.se2 import Array

LEVELS = np.linspace(0.0, 1.0, 51)  # of the plotted distribution of errors
_NUMBERS = ("x", "y", "cov_xx", "cov_xy", "cov_yy", "error_position", "error_heading", "nees")


@dataclass(frozen=True)
class Series:
    """One kind of trajectory of a run, N poses; NaN where unknown.

    ``t`` (N,) [s from the log's start]; ``x``, ``y`` [m]; ``error`` [m] and ``sigma`` [m]: twice the standard deviation in the
    least certain direction; ``nees`` and its ``dof``.
    """

    t: Array
    x: Array
    y: Array
    error: Array
    sigma: Array
    nees: Array
    dof: int


def read_series(estimates: bytes, t0_ns: int | None) -> dict[str, Series]:
    """The trajectories of ``estimates.parquet`` by kind: the causal one from the first localized estimate on, if there is any.

    Times are relative to ``t0_ns``, by default to the first tick.
    """
    table = parse_estimates(estimates, ESTIMATES, ("kind", "t_ns", "status", *_NUMBERS))
    start_ns = table["t_ns"].min() if t0_ns is None else t0_ns
    found = {}
    for kind, rows in by_kind(table).items():
        if len(rows):
            t = ((rows["t_ns"] - start_ns) / 1e9).to_numpy()
            found[kind] = _series(t, {name: _numbers(rows[name]) for name in _NUMBERS})
    return found


def _numbers(column: pl.Series) -> Array:
    return np.asarray(column.cast(pl.Float64).fill_null(math.nan).to_numpy(), dtype=float)


def _series(t: Array, columns: Mapping[str, Array]) -> Series:
    xx, xy, yy = (columns[f"cov_{name}"] for name in ("xx", "xy", "yy"))
    with np.errstate(invalid="ignore"):
        sigma = 2.0 * np.sqrt((xx + yy) / 2.0 + np.sqrt(np.square((xx - yy) / 2.0) + np.square(xy)))
    dof = 3 if np.isfinite(columns["error_heading"]).any() else 2
    return Series(t, columns["x"], columns["y"], columns["error_position"], sigma, columns["nees"], dof)


def thinned(series: Series, count: int) -> dict[str, list[float | None]]:
    """About ``count`` poses as plain values, to a millimetre and a millisecond; None where unknown.

    ``t``, ``x``, ``y``, ``e`` (position error) and ``s`` (sigma). Of each interval of time there are the poses with the smallest
    and with the largest error.
    """
    keep = _thin(series.error, count)
    columns = {"t": series.t, "x": series.x, "y": series.y, "e": series.error, "s": series.sigma}
    return {
        name: [round(v, 3) if math.isfinite(v) else None for v in values[keep].tolist()]
        for name, values in columns.items()
    }


def quantiles(errors: Sequence[Array]) -> Array:
    """Quantiles of the pooled errors of several runs at ``LEVELS``; empty without any error."""
    known = _known(np.concatenate(errors)) if errors else np.empty(0)
    return np.quantile(known, LEVELS) if len(known) else known


def consistency(series: Series) -> tuple[float, float, int] | None:
    """Mean NEES per degree of freedom, its effective number of independent values, and the degrees of freedom; None without any."""
    nees = _known(series.nees)
    return (float(np.mean(nees)) / series.dof, independent_count(nees), series.dof) if len(nees) > 1 else None


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

"""Trajectories and errors of runs, decimated and packed as small integers to limit the size of the page."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from factorgraph_loc.evaluation.estimates_file import NAME, parse_estimates
from factorgraph_loc.evaluation.inference import independent_count
from factors.se2 import Array

KINDS = ("causal", "final")
LEVELS = np.linspace(0.0, 1.0, 51)  # of the plotted distribution of errors
_COLUMNS = (
    "kind",
    "t_ns",
    "x",
    "y",
    "cov_xx",
    "cov_xy",
    "cov_yy",
    "cov_hh",
    "error_position",
    "error_heading",
    "nees",
    "status",
)
_LARGEST = 30000  # largest packed value, for four to five digits


@dataclass(frozen=True)
class Series:
    """One kind of trajectory of a run, N poses; NaN where unknown.

    ``t`` (N,) [s from the log's start]; ``x``, ``y`` [m]; ``error`` [m] and ``sigma`` [m]: twice the standard deviation in the
    least certain direction; ``heading_error`` and ``heading_sigma`` (twice) [rad]; ``nees`` and its ``dof``.
    """

    t: Array
    x: Array
    y: Array
    error: Array
    sigma: Array
    heading_error: Array
    heading_sigma: Array
    nees: Array
    dof: int

    def known_errors(self) -> Array:
        """The position errors [m] of poses that have a reference."""
        return _known(self.error)


def read_series(estimates: bytes, t0_ns: int | None) -> dict[str, Series]:
    """The trajectories of ``estimates.parquet`` by kind: the causal one from the first localized estimate on, if there is any.

    Times are relative to ``t0_ns``, by default to the first tick.
    """
    table = parse_estimates(estimates, NAME, _COLUMNS)
    columns = {name: _numbers(table[name]) for name in _COLUMNS if name not in ("kind", "t_ns", "status")}
    t_ns = table["t_ns"].to_numpy()
    t = (t_ns - (int(t_ns.min(initial=2**62)) if t0_ns is None else t0_ns)) / 1e9
    return {kind: _series(t[rows], {k: v[rows] for k, v in columns.items()}) for kind, rows in _kinds(table).items()}


def read_errors(estimates: bytes) -> dict[str, Array]:
    """The known position errors [m] of ``estimates.parquet`` by kind; see :func:`read_series`."""
    table = parse_estimates(estimates, NAME, ("kind", "status", "error_position"))
    errors = _numbers(table["error_position"])
    return {kind: _known(errors[rows]) for kind, rows in _kinds(table).items()}


def _kinds(table: pl.DataFrame) -> dict[str, slice]:
    """The rows of each kind, which are contiguous."""
    kind = table["kind"].to_numpy()
    found = {}
    for name in KINDS:
        rows = np.flatnonzero(kind == name)
        if name == "causal" and len(rows):
            localized = np.flatnonzero(table["status"].to_numpy()[rows] == "localized")
            rows = rows[localized[0] :] if len(localized) else rows[:0]
        if len(rows):
            found[name] = slice(int(rows[0]), int(rows[-1]) + 1)
    return found


def _numbers(column: pl.Series) -> Array:
    return np.asarray(column.cast(pl.Float64).fill_null(math.nan).to_numpy(), dtype=float)


def _series(t: Array, columns: Mapping[str, Array]) -> Series:
    xx, xy, yy = (columns[f"cov_{name}"] for name in ("xx", "xy", "yy"))
    largest = (xx + yy) / 2.0 + np.sqrt(np.square((xx - yy) / 2.0) + np.square(xy))
    with np.errstate(invalid="ignore"):
        sigma, heading_sigma = 2.0 * np.sqrt(largest), 2.0 * np.sqrt(columns["cov_hh"])
    return Series(
        t=t,
        x=columns["x"],
        y=columns["y"],
        error=columns["error_position"],
        sigma=sigma,
        heading_error=columns["error_heading"],
        heading_sigma=heading_sigma,
        nees=columns["nees"],
        dof=3 if np.isfinite(columns["error_heading"]).any() else 2,
    )


def pack(series: Series, count: int) -> dict[str, Any]:
    """About ``count`` poses: of each interval of time those with the smallest and the largest position error."""
    keep = _thin(series.error, count)
    return {
        "t": _pack(series.t[keep], deltas=True),
        "x": _pack(series.x[keep], deltas=True),
        "y": _pack(series.y[keep], deltas=True),
        "e": _pack(series.error[keep]),
        "s": _pack(series.sigma[keep]),
        "h": _pack(np.degrees(series.heading_error[keep])),
        "g": _pack(np.degrees(series.heading_sigma[keep])),
    }


def quantiles(errors: Sequence[Array]) -> list[float]:
    """Quantiles of the pooled errors of several runs at ``LEVELS``, with four digits."""
    known = np.concatenate(errors) if errors else np.empty(0)
    return [float(f"{q:.4g}") for q in np.quantile(known, LEVELS)] if len(known) else []


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


def _pack(values: Array, *, deltas: bool = False) -> dict[str, Any]:
    """Integers ``v`` in units of ``u``, a power of ten, null where unknown; with ``deltas`` as differences."""
    known = _known(values)
    largest = float(np.max(np.abs(known))) if len(known) else 0.0
    unit = 10.0 ** math.ceil(math.log10(largest / _LARGEST)) if largest > 0.0 else 1.0
    if deltas:
        whole = np.rint(values / unit).astype(np.int64)
        return {"u": unit, "d": np.diff(whole, prepend=0).tolist()}
    return {
        "u": unit,
        "v": [round(v / unit) if math.isfinite(v) else None for v in values.tolist()] if len(known) else [],
    }

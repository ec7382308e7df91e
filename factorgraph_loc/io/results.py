"""Reads the files of a stored run, which :func:`~factorgraph_loc.experiments.output.write_run` writes, and defines their names."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import foreign
from factorgraph_loc.files.columns import COVARIANCES, LATEST, symmetric
from factorgraph_loc.files.tables import parse_parquet
from factorgraph_loc.model.scoring import KINDS
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.text import error_text
from factors.se2 import Array

INDEX = "results.parquet"  # the table of all runs of an experiment
ESTIMATES, INNOVATIONS, EVENTS = "estimates.parquet", "innovations.parquet", "events.csv"
STAMP = "t_ns"
ERRORS = ("error_position", "error_heading", "nees")
NUMBERS = ("x", "y", "heading", *COVARIANCES, *ERRORS)
COLUMNS = {STAMP: pl.Int64, "kind": pl.String, "status": pl.String, **dict.fromkeys(NUMBERS, pl.Float64)}
FINAL, CAUSAL, LEARNT, CONFIG, METRICS = "final.tum", "causal.tum", "learnt.json", "config.toml", "metrics.json"
FILES = (FINAL, CAUSAL, ESTIMATES, INNOVATIONS, LEARNT, EVENTS, CONFIG, METRICS)  # METRICS is written last


@dataclass(frozen=True)
class Estimates:
    """The estimated poses of a stored run: causal ones from the measurements before each pose, or final ones from the
    whole log.

    ``trajectory``: N estimated poses. ``errors``: arrays (N,) with the keys "error_position" [m], "error_heading" [rad]
    and "nees", the normalised estimation error squared. An unknown error is NaN.
    """

    trajectory: Trajectory
    errors: dict[str, Array]

    @classmethod
    def of(cls, table: pl.DataFrame, t0_ns: int) -> "Estimates":
        """Return the estimates in ``table``, rows of ``estimates.parquet``, with times [s] since ``t0_ns`` [ns]."""
        numbers = {name: table[name].fill_null(np.nan).to_numpy() for name in NUMBERS}
        covariances = symmetric([numbers[name] for name in COVARIANCES])
        t = (table[STAMP].to_numpy() - t0_ns) / 1e9
        poses = np.column_stack([numbers[name] for name in ("x", "y", "heading")])
        return cls(Trajectory(t, poses, covariances), {name: numbers[name] for name in ERRORS})

    def rows(self, which: NDArray[np.bool_]) -> "Estimates":
        """Return those of the N estimates for which the boolean mask ``which`` (N,) is True."""
        return Estimates(self.trajectory.rows(which), {name: values[which] for name, values in self.errors.items()})


@dataclass(frozen=True)
class ResultFiles:
    """The files of a stored run. Methods raise InputError if a file is damaged.

    ``read``: a function that returns the content of a file by its name. ``folder``: the folder to name in errors.
    ``t0_ns``: the absolute time of t = 0 [ns]. If it is None, the first estimate is at t = 0, and the times of events
    and innovations are absolute [s].
    """

    read: Callable[[str], bytes]
    t0_ns: int | None = None
    folder: Path = Path()

    def estimates(self) -> dict[str, Estimates]:
        """Return {"causal": estimates, "final": estimates} of a run. Causal estimates use only earlier measurements.

        Final estimates use the whole log. Causal estimates before the first localization are omitted.
        """
        source = self.folder / ESTIMATES
        table = parse_parquet(self.read(ESTIMATES), source, list(COLUMNS))
        with foreign(source, "is no table of estimates"):
            table = table.cast(COLUMNS)  # type: ignore[arg-type]
        if not table[STAMP].is_between(-LATEST, LATEST).fill_null(value=False).all():
            raise InputError(f"{source}: a row has no timestamp in {STAMP}, or one beyond {LATEST:.1e} ns")
        t0_ns = table[STAMP].min() if self.t0_ns is None else self.t0_ns
        by_kind = {kind: table.filter(pl.col("kind") == kind) for kind in KINDS}
        localized = (by_kind["causal"]["status"] == "localized").arg_true()
        first = int(localized[0]) if len(localized) else len(by_kind["causal"])
        by_kind["causal"] = by_kind["causal"][first:]
        try:
            return {kind: Estimates.of(rows, t0_ns) for kind, rows in by_kind.items()}  # type: ignore[arg-type]
        except ValueError as error:
            raise InputError(f"{source}: contains no valid trajectory: {error_text(error)}") from error

    def innovations(self) -> dict[str, Array]:
        """Return {sensor: array (K, 3)} with one row for each of K updates by the sensor.

        The columns are the time [s], the normalised innovation squared, and its degrees of freedom."""
        table = parse_parquet(self.read(INNOVATIONS), self.folder / INNOVATIONS)
        table = table.select("sensor", (pl.col(STAMP) - (self.t0_ns or 0)) / 1e9, "nis", "dof")
        groups = table.group_by("sensor", maintain_order=True)
        return {str(sensor): rows.drop("sensor").to_numpy() for (sensor,), rows in groups}

    def events(self) -> tuple[tuple[float, str], ...]:
        """Return the time [s] and the text of each event."""
        source = self.folder / EVENTS
        with foreign(source, "is no table of events"):
            table = pl.read_csv(self.read(EVENTS), schema_overrides={STAMP: pl.Int64, "event": pl.String})
            table = table.select(STAMP, "event")
        if table.null_count().sum_horizontal().item() or not table[STAMP].is_between(-LATEST, LATEST).all():
            raise InputError(f"{source}: a row has no timestamp or no event, or a timestamp beyond {LATEST:.1e} ns")
        return tuple(((t_ns - (self.t0_ns or 0)) / 1e9, text) for t_ns, text in table.iter_rows())

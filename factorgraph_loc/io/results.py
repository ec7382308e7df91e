"""Files of a result folder: their names, and the table of a run's estimates; see
:func:`~factorgraph_loc.experiments.output.write_run`."""

from collections.abc import Sequence

import numpy as np
import polars as pl

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import foreign
from factorgraph_loc.files.columns import LATEST
from factorgraph_loc.files.tables import parse_parquet
from factorgraph_loc.model.trajectory import COVARIANCES, Trajectory

INDEX = "results.parquet"  # of several runs
ESTIMATES, INNOVATIONS, EVENTS = "estimates.parquet", "innovations.parquet", "events.csv"
KINDS = ("causal", "final")
TEXTS, STAMP = ("kind", "status"), "t_ns"
NUMBERS = (
    *("x", "y", "heading", *COVARIANCES),
    *("error_position", "error_heading", "nees"),
)
COLUMNS = (STAMP, *TEXTS, *NUMBERS)
FILES = (
    "final.tum",
    "causal.tum",
    ESTIMATES,
    INNOVATIONS,
    "learnt.json",
    EVENTS,
    "config.toml",
    "metrics.json",
)  # the last one is written last


def trajectory_of(table: pl.DataFrame, t0_ns: int) -> Trajectory:
    """The poses in rows of an ``estimates.parquet``, in seconds after ``t0_ns``."""
    covariances = np.empty((len(table), 3, 3))
    for name, (i, j) in COVARIANCES.items():
        covariances[:, i, j] = covariances[:, j, i] = table[name].cast(pl.Float64).fill_null(np.nan).to_numpy()
    t = (table["t_ns"].to_numpy() - t0_ns) / 1e9
    return Trajectory(t, table.select("x", "y", "heading").fill_null(np.nan).to_numpy(), covariances)


def parse_events(content: bytes, source: object, t0_ns: int) -> tuple[tuple[float, str], ...]:
    """Time [s after ``t0_ns``] and text of the events in the bytes of ``events.csv``. Raises InputError with ``source``."""
    with foreign(source, "is no table of events"):
        table = pl.read_csv(content, schema_overrides={"t_ns": pl.Int64, "event": pl.String}).select("t_ns", "event")
    if table.null_count().sum_horizontal().item() or not table["t_ns"].is_between(-LATEST, LATEST).all():
        raise InputError(f"{source}: has a row without a stamp and an event, expected both")
    return tuple(((t_ns - t0_ns) / 1e9, text) for t_ns, text in table.iter_rows())


def by_kind(table: pl.DataFrame) -> dict[str, pl.DataFrame]:
    """The rows of each of :data:`KINDS`: the causal ones from the first localized estimate on, and the final ones."""
    found = {kind: table.filter(pl.col("kind") == kind) for kind in KINDS}
    localized = (found["causal"]["status"] == "localized").arg_true()
    found["causal"] = found["causal"][int(localized[0]) :] if len(localized) else found["causal"].clear()
    return found


def parse_estimates(content: bytes, source: object, columns: Sequence[str] = COLUMNS) -> pl.DataFrame:
    """Some ``columns`` of the table in the bytes of the file, numbers as floats, null where unknown.

    Raises InputError with ``source`` if the file is damaged."""
    table = parse_parquet(content, source, columns)
    for name in columns:
        kind = table.schema[name]
        is_right = (kind == pl.String) if name in TEXTS else kind.is_integer() if name == STAMP else kind.is_numeric()
        if not is_right and kind != pl.Null:
            raise InputError(f"{source}: {name} is of type {kind}, expected {'texts' if name in TEXTS else 'numbers'}")
    table = table.select(pl.col(name).cast(_kind(name), strict=False) for name in columns)
    if STAMP in columns and not table[STAMP].is_between(-LATEST, LATEST).fill_null(value=False).all():
        raise InputError(f"{source}: {STAMP} has a row without a stamp, or with one beyond {LATEST:.1e} ns")
    return table


def _kind(name: str) -> type[pl.DataType]:
    return pl.String if name in TEXTS else pl.Int64 if name == STAMP else pl.Float64

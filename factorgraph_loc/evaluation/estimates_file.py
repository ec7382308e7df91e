"""Reader of a run's ``estimates.parquet``; see :func:`~factorgraph_loc.experiments.output.write_run`."""

from collections.abc import Sequence

import polars as pl

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.columns import LATEST
from factorgraph_loc.files.tables import parse_parquet

NAME = "estimates.parquet"
TEXTS, STAMP = ("kind", "status"), "t_ns"
NUMBERS = (
    *("x", "y", "heading", "cov_xx", "cov_xy", "cov_xh", "cov_yy", "cov_yh", "cov_hh"),
    *("error_position", "error_heading", "nees"),
)
COLUMNS = (STAMP, *TEXTS, *NUMBERS)


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

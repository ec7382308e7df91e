"""Parquet files; declared sizes are checked before polars unpacks them."""

import io
from collections.abc import Sequence
from pathlib import Path

import polars as pl

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import parquet_pages
from factorgraph_loc.files.bounded import DATA, foreign, read_bytes, require_size
from factorgraph_loc.files.quiet import quiet


def read_parquet(path: Path) -> pl.DataFrame:
    """The table in a Parquet file; InputError if it is invalid or too large."""
    return parse_parquet(read_bytes(path, DATA), path)


def parse_parquet(content: bytes, source: object, columns: Sequence[str] | None = None) -> pl.DataFrame:
    """The table, or some ``columns`` of it, in the bytes of a Parquet file; InputError as in :func:`read_parquet`."""
    with foreign(source, "is not a Parquet file that can be read"), quiet():
        parquet_pages.check(content, source)
        return pl.read_parquet(io.BytesIO(content), columns=None if columns is None else list(columns))


def text_column(table: pl.DataFrame, name: str, source: object) -> list[str]:
    """A column of texts or integers as texts, "" for null; InputError if it has another type."""
    column = table[name]
    kind = column.dtype
    if not (kind in (pl.String, pl.Null, pl.Categorical) or kind.is_integer() or isinstance(kind, pl.Enum)):
        raise InputError(f"{source}: {name} is of type {kind}, expected texts")
    with foreign(source, f"{name} is no column of texts"):
        found = column.cast(pl.String)
        if len(found) * found.estimated_size() > DATA:  # one long text may be referenced many times
            length = int(found.str.len_bytes().sum())
            require_size(source, f"the length of all texts of {name}", length, DATA)
        return [text or "" for text in found.to_list()]

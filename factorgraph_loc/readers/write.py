"""A log into files: the native format, or a ROS bag where the name is one."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from factorgraph_loc.log import Log
from factorgraph_loc.readers.bag_export import write_bag
from factorgraph_loc.readers.bag_file import SUFFIXES
from factorgraph_loc.readers.native import write_native


def write_log(log: Log, out: str | Path, format: Literal["csv", "parquet"] = "csv") -> list[Path]:
    """Write a log to ``out``, at once or not at all, and return the files that were written.

    A bag (:func:`~factorgraph_loc.readers.bag_export.write_bag`) where the name ends as one, else a folder in the native format
    with tables of ``format`` (:func:`~factorgraph_loc.readers.native.write_native`). InputError if something is there already.
    """
    out = Path(out)
    if out.suffix in SUFFIXES:
        return write_bag(log, out)
    write_native(log, out, format=format)
    return sorted(out.iterdir())

"""A log into files: the native format, or a ROS bag where the name is one."""

from pathlib import Path
from typing import Literal

from factorgraph_loc.io.bags.export import write_bag
from factorgraph_loc.io.bags.file import SUFFIXES
from factorgraph_loc.io.native.native import write_native
from factorgraph_loc.model.log import Log


def write_log(log: Log, out: str | Path, format: Literal["csv", "parquet"] = "csv") -> list[Path]:
    """Write a log to ``out``, at once or not at all, and return the files that were written.

    A bag (:func:`~factorgraph_loc.io.bags.export.write_bag`) where the name ends as one, else a folder in the native format
    with tables of ``format`` (:func:`~factorgraph_loc.io.native.native.write_native`). InputError if something is there already.
    """
    out = Path(out)
    if out.suffix in SUFFIXES:
        return write_bag(log, out)
    write_native(log, out, format=format)
    return sorted(out.iterdir())

"""Writing of a log in the native format or as a ROS bag."""

from pathlib import Path
from typing import Literal

from factorgraph_loc.io.bags.export import write_bag
from factorgraph_loc.io.bags.file import SUFFIXES
from factorgraph_loc.io.native.native import write_native
from factorgraph_loc.model.log import Log


def write_log(
    log: Log, out: str | Path, format: Literal["csv", "parquet"] = "csv", *, overwrite: bool = False
) -> list[Path]:
    """Write a log to ``out`` atomically, and return the files.

    A bag (:func:`~factorgraph_loc.io.bags.export.write_bag`) if the name is that of one, else a folder in the native format with
    tables of ``format`` (:func:`~factorgraph_loc.io.native.native.write_native`). InputError if ``out`` exists, unless it
    is a log to ``overwrite``.
    """
    out = Path(out)
    if out.suffix in SUFFIXES:
        return write_bag(log, out, overwrite=overwrite)
    write_native(log, out, format=format, overwrite=overwrite)
    return sorted(out.iterdir())

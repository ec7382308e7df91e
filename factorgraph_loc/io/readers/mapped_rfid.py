"""Reads RFID reads from CSV or JSON lines of other programs, by a mapping of columns. Presets describe the files of common tools.

A table may also have a column of signal strengths for each tag or each antenna.
"""

import base64
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from factorgraph_loc.errors import InputError
from factorgraph_loc.files import bounded, shipped
from factorgraph_loc.files.cells import Cells
from factorgraph_loc.files.column_mapping import (
    ColumnMapping,
    ReadNames,
    TableFolder,
    TimedMapping,
    in_case,
    read_mapped,
)
from factorgraph_loc.files.columns import PURE, STAMP, Column
from factorgraph_loc.files.models import FileModel, InUnit, read_toml
from factorgraph_loc.files.row_rules import Fault
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.sensors.rfid.stream import RFID
from factorgraph_loc.sensors.rfid.tables import SIGNALS
from factorgraph_loc.text import Notice, listed, notice, quoted
from factors.se2 import Array

NAME = "the * of "  # in errors, "the * of rssi_*" means the text that replaces * in the name of a column
EPCS = ("epc", "epc_base64")
OPTIONAL = (*SIGNALS, *EPCS, "channel", "last", "count")
CHANNEL = Column("channel", "whole", PURE, 1.0, 1000.0, True, "the number of a channel")
COUNT = Column("count", "number", PURE, 0.0, 1e9, True, "number of reads in the row")
REQUIRED = tuple(tuple(("t", epc, *antenna) for epc in EPCS) for antenna in (("antenna",), ()))
STANDARD = str.maketrans("-_", "+/")  # converts URL-safe base64 to standard base64


def read_wide(path: Path, mapping: ColumnMapping, antenna: str | None) -> Cells:
    """Return the reads of a table with several columns of signal strengths. Their names match a pattern such as
    ``rssi_*``.

    ``mapping``: the columns of the fields; the pattern is the column of ``rssi``. Each cell of a matching column that
    is not empty is a read. The text in place of ``*`` is the antenna's name, or the EPC of the tag if the antenna is
    known. The antenna is known if ``mapping`` has a column for it, or if ``antenna``, the name of the only antenna, is
    given. Raises InputError at an invalid value.
    """
    pattern = mapping.columns["rssi"]
    fixed = {field: column for field, column in mapping.columns.items() if field != "rssi"}
    missing = "epc" if "antenna" in fixed or antenna is not None else "antenna"
    if set(fixed) | {missing} != {"t", "epc", *(() if antenna is not None else ("antenna",))} or missing in fixed:
        expected = "t and one of epc, antenna" if antenna is None else "t"
        raise InputError(f"{path}: columns with rssi = {quoted(pattern)} has {listed(fixed)}, expected {expected}")
    units = {field: unit for field, unit in mapping.units.items() if field != "rssi"}
    narrow = read_mapped(path, mapping.model_copy(update={"columns": fixed, "units": units}), (tuple(fixed),))
    named = re.compile("(.+)".join(map(re.escape, pattern.split("*", 1))), re.DOTALL)
    names = {column: match[1] for column in narrow.left_out if (match := named.fullmatch(column))}
    if not names:
        raise InputError(f"{path}: has no column that matches {quoted(pattern)}, only {listed(narrow.left_out)}")
    strengths = {f"{NAME}{column}": column for column in names}
    wide_mapping = mapping.model_copy(update={"columns": fixed | strengths, "units": units})
    wide = read_mapped(path, wide_mapping, (tuple(fixed),), tuple(strengths))
    reads = [(i, name) for i in range(len(wide.rows)) for name in strengths if wide.columns[name][i]]
    if not reads:
        raise InputError(f"{path}: contains no reads: all cells of {quoted(pattern)} are empty")
    columns = {field: [wide.columns[field][i] for i, _ in reads] for field in fixed}
    columns["rssi"] = [wide.columns[name][i] for i, name in reads]
    columns[missing] = [names[strengths[name]] for _, name in reads]
    labels = {**fixed, "rssi": pattern, missing: NAME + pattern}
    rows = wide.rows[[i for i, _ in reads]]
    return replace(wide, rows=rows, columns=columns, labels=labels, units=mapping.units)


class Channels(FileModel):
    """The carrier frequencies of evenly spaced channels."""

    first: Annotated[float, Field(gt=100.0, lt=10_000.0), InUnit("MHz")]
    """frequency of channel 1"""
    step: Annotated[float, Field(gt=0.0, lt=100.0), InUnit("MHz")]
    """difference in frequency between neighbouring channels"""


@cache
def presets() -> dict[str, dict[str, dict[str, str]]]:
    """Return the settings ``columns`` and ``units`` for the RFID logs of known programs, by the name of the program."""
    content: dict[str, dict[str, dict[str, str]]] = read_toml(shipped.readers()["mapped"])
    return content


class RfidFile(TimedMapping, ReadNames):
    """A table of RFID reads. ``columns`` maps t, epc or epc_base64, antenna, rssi, phase, and frequency or channel.

    A ``*`` in the column of rssi matches several columns, one for each tag or antenna. A row may summarize several
    reads. Then t and ``last`` are the times of the first and the last read, and ``count`` is their number.
    """

    columns: dict[str, str] = Field(default_factory=dict)
    """column of the file for each field, in addition to those of the preset"""
    preset: Literal["impinj_itemtest", "impinj_iot", "sllurp_log", "sllurp_reports"] | None = None
    """known tool; its columns and units are used unless they are given here"""
    channels: tuple[Annotated[float, Field(gt=100.0, lt=10_000.0), InUnit("MHz")], ...] | Channels | None = None
    """frequencies of channels 1, 2, ..."""
    round_gap: Annotated[float, Field(gt=0.0, le=10.0), InUnit("s")] | None = None
    """gap between reads that ends an inventory round"""

    @model_validator(mode="before")
    @classmethod
    def _of_preset(cls, content: Any) -> Any:
        """Add the columns and units of the preset to the settings ``content``, unless ``content`` has them."""
        name = content.get("preset") if isinstance(content, dict) else None
        preset = presets().get(name) if isinstance(name, str) else None
        if preset is None or not all(isinstance(content.get(part, {}), dict) for part in preset):
            return content
        columns = preset["columns"] | content.get("columns", {})
        units = preset["units"] | content.get("units", {})
        if "antenna" in content:
            columns.pop("antenna", None)
        if "channels" not in content:
            columns.pop("channel", None)
        return {**content, "columns": columns, "units": units}


def read_all_reads(folder: TableFolder, options: RfidFile) -> TableRows:
    """Return the reads of the file in ``folder`` that the options name. A name with ``*`` stands for all files that match it."""
    if "*" not in options.file:
        return read_reads(folder, folder.file(options.file), options)
    folder.file(options.file.replace("*", "x"))
    with bounded.foreign(folder.path, f"rfid.file is {options.file[:80]!r}"):  # pathlib may reject the pattern
        files = sorted(file for file in folder.path.glob(options.file) if file.is_file())
    if not files:
        raise InputError(f"{folder.path}: rfid.file is {quoted(options.file)}, expected the names of existing files")
    tables = [read_reads(folder, folder.file(str(file.relative_to(folder.path))), options) for file in files]
    return joined(folder.path / options.file, tables)


def joined(path: Path, tables: Sequence[TableRows]) -> TableRows:
    """Return all rows of several tables of RFID reads, sorted by time. ``path``: the name of the result in errors."""
    reads = _concatenated(path, tables)
    return reads.rows_at(np.argsort(reads.t_ns, kind="stable"))


def _concatenated(path: Path, tables: Sequence[TableRows]) -> TableRows:
    return TableRows(
        path,
        np.concatenate([table.rows for table in tables]),
        np.concatenate([table.t_ns for table in tables]),
        {name: np.concatenate([table.numbers[name] for table in tables]) for name in SIGNALS},
        {name: [text for table in tables for text in table.names[name]] for name in ("epc", "antenna")},
    )


def read_reads(folder: TableFolder, path: Path, options: RfidFile) -> TableRows:
    """Return the RFID reads of one file, sorted by time. ``options``: describe its columns.

    A row that summarizes several reads gives two: the first, with the measured values, and the last.
    ``folder.warnings`` receives warnings. Raises InputError with file, row and column of an invalid value.
    """
    wide = "*" in options.columns.get("rssi", "")
    if not wide and ("antenna" in options.columns) == (options.antenna is not None):
        raise InputError(
            f"{path}: needs either columns.antenna, or antenna, the name of the only antenna: set one of the two"
        )
    if "channel" in options.columns and options.channels is None:
        raise InputError(f"{path}: columns has channel, but channels is missing: give the frequencies [MHz]")
    if "channel" not in options.columns and options.channels is not None:
        raise InputError(f"{path}: channels is given, but columns has no channel: add it, or remove channels")
    if {"channel", "frequency"} <= set(options.columns):
        raise InputError(f"{path}: columns has frequency and channel: remove one of them")
    shapes = REQUIRED[0] if options.antenna is None else REQUIRED[1]
    cells = read_wide(path, options, options.antenna) if wide else read_mapped(path, options, shapes, OPTIONAL, EPCS)
    mapped = folder.record_read(cells, options, _columns_of(options), _epcs(cells)[1])
    mapped.require(_epcs(mapped)[1])
    mapped = _in_sequence(mapped, options, folder.warnings)
    t_ns = mapped.stamps("t", options.clock_offset)
    antennas = [options.antenna] * len(t_ns) if options.antenna else mapped.names("antenna", RFID["antenna"])
    numbers = {name: _signal(mapped, name) for name in SIGNALS}
    if "channel" in mapped.columns:
        numbers["frequency"] = _frequencies(mapped, options.channels)
    table = TableRows(
        path,
        mapped.rows,
        t_ns,
        numbers,
        {
            "epc": in_case(_epcs(mapped)[0], options.epc_case),
            "antenna": [options.antennas.get(str(a), str(a)) for a in antennas],
        },
    )
    return joined(path, [_with_last(table, mapped, options, folder.warnings)])


def _signal(mapped: Cells, name: str) -> Array:
    return mapped.numbers(name, RFID[name]) if name in mapped.columns else np.full(len(mapped.rows), np.nan)


def _columns_of(options: RfidFile) -> dict[str, Column]:
    """Return a description of each field of a read except the EPC, by its name, such as "rssi"."""
    known = {name: RFID[name] for name in ("antenna", *SIGNALS)}
    return known | {"channel": _channel(options.channels), "last": STAMP, "count": COUNT}


def _channel(channels: tuple[float, ...] | Channels | None) -> Column:
    return replace(CHANNEL, high=len(channels)) if isinstance(channels, tuple) else CHANNEL


def _epcs(mapped: Cells) -> tuple[list[str], list[Fault]]:
    """Return the EPC of each row as hexadecimal digits, and the faults of empty and invalid EPCs.

    The quotes around EPCs such as ``b'30F4'``, which some versions of sllurp write, are removed."""
    texts, faults = [""] * len(mapped.rows), []
    if "epc" in mapped.columns:
        texts = mapped.texts("epc")
    if "epc_base64" in mapped.columns:
        coded = [
            None if text else _from_base64(code) for text, code in zip(texts, mapped.texts("epc_base64"), strict=True)
        ]
        faults.append(
            mapped.fault("epc_base64", np.array([code == "?" for code in coded], dtype=bool), "an EPC in base64")
        )
        texts = [text or str(code) for text, code in zip(texts, coded, strict=True)]
    field = "epc" if "epc" in mapped.columns else "epc_base64"
    if field in mapped.columns:
        faults.append(mapped.fault(field, np.array([not text for text in texts], dtype=bool), RFID["epc"].doc))
    return [text[2:-1] if text.startswith("b'") and text.endswith("'") else text for text in texts], faults


def _from_base64(text: str) -> str:
    """Return an EPC in base64 as upper-case hexadecimal digits. Return a question mark if ``text`` is not base64."""
    try:
        return base64.b64decode(text.translate(STANDARD) + "=" * (-len(text) % 4), validate=True).hex().upper()
    except ValueError:
        return "?"


def _in_sequence(mapped: Cells, options: RfidFile, warnings: list[Notice]) -> Cells:
    """Return the rows of ``mapped``, each with the times of its first and last read.

    Raises InputError at a row whose last read is before its first read. If the options skip invalid rows, such rows are
    left out instead, and a warning is appended to ``warnings``."""
    if "last" not in mapped.columns:
        return mapped
    wrong = mapped.stamps("last", options.clock_offset) < mapped.stamps("t", options.clock_offset)
    return mapped.without([mapped.fault("last", wrong, "a time not before the first")], warnings)


def _frequencies(mapped: Cells, channels: tuple[float, ...] | Channels | None) -> Array:
    """Return the carrier frequencies (N,) [Hz] of N reads. NaN if the channel of a read is unknown.

    ``mapped``: the reads with channel numbers, which start at 1. ``channels``: the frequencies of the channels [MHz].
    """
    number = mapped.numbers("channel", _channel(channels))
    if isinstance(channels, Channels):
        return np.asarray((channels.first + (number - 1.0) * channels.step) * 1e6)
    table = np.array((*(channels or ()), np.nan)) * 1e6
    return np.asarray(table[np.where(np.isnan(number), len(table), number).astype(np.int64) - 1])


def _with_last(table: TableRows, mapped: Cells, options: RfidFile, warnings: list[Notice]) -> TableRows:
    """Return ``table`` with one more read for each row that summarizes several reads.

    This read has the timestamp of the last read and no measured values. A warning about the reads between the first and
    the last, which have no timestamps, is appended to ``warnings``."""
    if "last" not in mapped.columns:
        if "count" in mapped.columns and (many := int(np.count_nonzero(mapped.numbers("count", COUNT) > 1.0))):
            sentence = "{source}: {rows} rows summarize several reads with one timestamp: each counts as one read"
            warnings.append(notice("summarized_reads", sentence, table.path, many))
        return table
    last_ns = mapped.stamps("last", options.clock_offset)
    several = last_ns > table.t_ns
    if "count" in mapped.columns:
        count = np.nan_to_num(mapped.numbers("count", COUNT), nan=1.0)
        several &= count > 1.0
        if more := int(np.sum(np.maximum(count - np.where(several, 2.0, 1.0), 0.0))):
            sentence = "{source}: {reads} reads are skipped: a row with several reads has only the times of the first and the last"
            warnings.append(notice("summarized_reads", sentence, table.path, more))
    repeated = table.rows_at(np.flatnonzero(several))
    unknown = {name: np.full(len(repeated.rows), np.nan) for name in repeated.numbers}
    return _concatenated(table.path, (table, replace(repeated, t_ns=last_ns[several], numbers=unknown)))

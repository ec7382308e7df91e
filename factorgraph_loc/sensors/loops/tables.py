"""Loops from tables, and pushed by a program."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.files.values import numbers, within
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.sensors.loops.measurement import LEAST_AGE, LOOPS, LOOPS_BY_STAMP, Loops
from factorgraph_loc.sensors.tables import Reading, stream_of

POSE = ("x", "y", "heading")


def assemble(rows: Mapping[str, TableRows], reading: Reading) -> Stream:
    """The loops of a log. InputError for an earlier pose that is not earlier, and for a part of a relative pose."""
    (table,) = rows.values()
    columns = dict(table.numbers)
    if "before_ns" in columns:
        stamps = columns.pop("before_ns")
        LOOPS_BY_STAMP["before_ns"].require(table.path, table.rows, stamps)
        columns["age"] = (table.t_ns - np.rint(stamps).astype(np.int64)) / 1e9
        if len(bad := np.flatnonzero(columns["age"] < LEAST_AGE)):
            i = int(bad[0])
            expected = f"an earlier time than that of the row, {int(table.t_ns[i])} ns"
            raise bad_field(table.path, "before_ns", f"{stamps[i]:.0f} ns", expected, row=int(table.rows[i]))
    for name in (*POSE, "score"):
        columns.setdefault(name, np.full(len(table.rows), np.nan))
    known = np.isfinite([columns[name] for name in POSE])
    if len(bad := np.flatnonzero(known.any(axis=0) & ~known.all(axis=0))):
        i = int(bad[0])
        lacking = next(name for name in POSE if np.isnan(columns[name][i]))
        raise bad_field(table.path, lacking, "", "x, y and heading, or none of them", row=int(table.rows[i]))
    return stream_of(LOOPS, replace(table, numbers=columns), reading.t0_ns, reading.warnings)


def check(m: Loops, where: str) -> dict[str, Any]:
    """The validated fields of a pushed measurement, copied; InputError names the first invalid one."""
    count = numbers(where, "age", m.age).size
    found = {name: within(where, LOOPS[name], getattr(m, name), (count,)) for name in ("age", *POSE, "score")}
    known = np.isfinite([found[name] for name in POSE])
    if (known.any(axis=0) & ~known.all(axis=0)).any():
        raise InputError(f"{where}: a loop has a part of a relative pose, expected x, y and heading, or none of them")
    return found

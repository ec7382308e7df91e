"""Conversion of odometry tables to streams."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from factorgraph_loc.files import checks
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.sensors.odometry.columns import INCREMENTS, VELOCITIES
from factorgraph_loc.sensors.odometry.stream import IncrementStream
from factorgraph_loc.sensors.tables import Reading, stream_of


def assemble(rows: Mapping[str, TableRows], reading: Reading) -> Stream:
    """The stream of velocities or increments; rows with equal timestamps are merged."""
    told = rows["odometry"]
    if "dx" not in told.numbers:
        return stream_of(VELOCITIES, told, reading.t0_ns, reading.warnings)
    moves = np.column_stack([told.numbers[column.name] for column in INCREMENTS.columns[1:]])
    t_ns, moves = checks.increments_in_order(told.path, told.rows, told.t_ns, moves, reading.warnings)
    return IncrementStream(checks.seconds(t_ns, reading.t0_ns), *np.ascontiguousarray(moves.T))

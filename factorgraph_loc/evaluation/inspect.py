"""Inspection of a log: its content and its problems."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgraph_loc.io.checks import gap_warnings, long_gaps
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.interfaces import Summary
from factorgraph_loc.sensors.registry import functions
from factorgraph_loc.text import Notice, notice
from factors.se2 import Array


@dataclass(frozen=True)
class StreamSummary:
    """One stream: rows, median rate [Hz], first and last stamp [s], and long gaps (start, length) [s]."""

    rows: int
    rate: float
    first: float
    last: float
    gaps: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Inspection:
    """The content of a log: streams and reference, results of each sensor (``sensors``, by name), and problems."""

    streams: Mapping[str, StreamSummary]
    reference: StreamSummary | None
    problems: tuple[Notice, ...]
    sensors: Mapping[str, Summary]

    @property
    def found(self) -> dict[str, Any]:
        """The results of all sensors, by key (``unseen``, ``rfid``, ...)."""
        return {key: value for summary in self.sensors.values() for key, value in summary.found.items()}

    @property
    def in_map(self) -> dict[str, int]:
        """The number of objects in each layer of the map."""
        return {layer: count for summary in self.sensors.values() for layer, count in summary.in_map.items()}


def inspect(log: Log) -> Inspection:
    """Inspect a log: summaries of its streams, and problems."""
    streams = {name: _summary(stream.t) for name, stream in log.streams.items()}
    reference = None if log.reference is None else _summary(log.reference.t)
    problems = list(log.warnings)
    missing = [sensor for sensor in log.rig.sensors if sensor not in streams]
    problems += [notice("no_stream", "the log has no {sensor}, which the rig lists", sensor) for sensor in missing]
    empty = [name for name, summary in streams.items() if summary.rows == 0]
    problems += [notice("empty_stream", "{stream} is empty", name) for name in empty]
    for name, summary in (*streams.items(), *([("reference", reference)] if reference else [])):
        problems += gap_warnings(name, summary.gaps)
    sensors = {name: summarize(log) for name, summarize in functions("summarize")}
    problems += [problem for summary in sensors.values() for problem in summary.problems]
    return Inspection(streams, reference, tuple(dict.fromkeys(problems)), sensors)


def _summary(t: Array) -> StreamSummary:
    """Summary of a stream with stamps (N,) in order of arrival."""
    if len(t) == 0:
        return StreamSummary(0, 0.0, 0.0, 0.0, ())
    stamps = np.unique(t)
    steps = np.diff(stamps)
    rate = 1.0 / float(np.median(steps)) if len(steps) else 0.0
    return StreamSummary(len(t), rate, float(stamps[0]), float(stamps[-1]), long_gaps(stamps))

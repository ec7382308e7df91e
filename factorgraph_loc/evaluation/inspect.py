"""Inspection of a log: a summary of its content, and warnings about problems. ``fgloc info`` prints it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factorgraph_loc.io.checks import gap_warnings, long_gaps
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.sections import kind_of
from factorgraph_loc.sensors.interfaces import Summary
from factorgraph_loc.sensors.registry import functions
from factorgraph_loc.text import Notice, notice
from factors.se2 import Array


@dataclass(frozen=True)
class StreamSummary:
    """Summary of a stream: the number of rows, the median ``rate`` [Hz], the ``first`` and ``last`` timestamp [s].

    ``gaps``: start and length [s] of each interval between timestamps that is much longer than usual.
    """

    rows: int
    rate: float
    first: float
    last: float
    gaps: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Inspection:
    """A summary of the content of a log.

    ``streams``: by name, a summary of each stream. ``reference``: summary of the reference trajectory, None if the log
    has none. ``problems``: warnings. ``sensors``: by sensor, a summary of its measurements.
    """

    streams: Mapping[str, StreamSummary]
    reference: StreamSummary | None
    problems: tuple[Notice, ...]
    sensors: Mapping[str, Summary]

    @property
    def found(self) -> dict[str, Any]:
        """Statistics of the measurements as {key: value}, such as ``{"unseen": [...]}``, from all sensors. If the rig
        has several sensors of a kind, their statistics are nested: {name of the sensor: {key: value}}."""
        entries: dict[str, Any] = {}
        for name, summary in self.sensors.items():
            entries |= summary.found if kind_of(name) == name else {name: dict(summary.found)}
        return entries

    @property
    def in_map(self) -> dict[str, int]:
        """The number of objects in each layer of the map, such as landmarks and tags."""
        return {layer: count for summary in self.sensors.values() for layer, count in summary.in_map.items()}


def inspect(log: Log) -> Inspection:
    """Return a summary of a log: its streams, its reference, the measurements of its sensors, and warnings about
    problems."""
    streams = {name: _summary(stream.t) for name, stream in log.streams.items()}
    reference = None if log.reference is None else _summary(log.reference.t)
    problems = list(log.warnings)
    missing = [sensor for sensor in log.rig.sensors if sensor not in streams]
    problems += [notice("no_stream", "the log has no {sensor}, which the rig lists", sensor) for sensor in missing]
    empty = [name for name, summary in streams.items() if summary.rows == 0]
    problems += [notice("empty_stream", "{stream} is empty", name) for name in empty]
    for name, summary in (*streams.items(), *([("reference", reference)] if reference else [])):
        problems += gap_warnings(name, summary.gaps)
    sensors = {
        name: _with_sensor_name(name, summarize(log.alone(name))) for name, summarize in functions("summarize", log.rig)
    }
    problems += [problem for name in sensors for problem in _problems(name, sensors)]
    return Inspection(streams, reference, tuple(dict.fromkeys(problems)), sensors)


def _with_sensor_name(name: str, summary: Summary) -> Summary:
    """Return a summary that names the sensor in each line if there are several sensors of its kind."""
    if kind_of(name) == name:
        return summary
    text = [replace(paragraph, line=f"{name}: {paragraph.line}") for paragraph in summary.text]
    return replace(summary, problems=[problem.about(name) for problem in summary.problems], text=text)


def _problems(name: str, sensors: Mapping[str, Summary]) -> list[Notice]:
    """Return the warnings of the sensor ``name``. ``sensors``: by sensor, its summary. A landmark or tag is reported as
    undetected only if no sensor of the kind detects it."""
    of_kind = [summary for each, summary in sensors.items() if kind_of(each) == kind_of(name)]
    undetected = [each for each in sensors[name].undetected if all(each in summary.undetected for summary in of_kind)]
    return [*sensors[name].problems, *undetected]


def _summary(t: Array) -> StreamSummary:
    """Return a summary of a stream. ``t`` (N,): timestamps [s] in the order of the rows."""
    if len(t) == 0:
        return StreamSummary(0, 0.0, 0.0, 0.0, ())
    stamps = np.unique(t)
    steps = np.diff(stamps)
    rate = 1.0 / float(np.median(steps)) if len(steps) else 0.0
    return StreamSummary(len(t), rate, float(stamps[0]), float(stamps[-1]), long_gaps(stamps))

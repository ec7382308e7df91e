"""A recorded or simulated run: rig, world, measurements by sensor, and the reference trajectory if there is one."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.measurement import Measurement, Rows, Stream, joined, selected
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.sections import as_only, kind_of
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.text import Notice, well_formed
from factors.se2 import Array, Integers

NOT_READ = "not read"  # key of the metadata: columns, files or topics that the reader leaves out
RIG_NOTES = "robot"  # key of the metadata: notes about a rig that the reader derives from the data


@dataclass(frozen=True)
class StartPose:
    """A known start of the robot. ``pose`` (3,): x, y [m], heading [rad] in the world frame at time ``t`` [s].
    ``sigmas`` (3,): standard deviations of x, y [m] and heading [rad]."""

    t: float
    pose: Array
    sigmas: Array


@dataclass(frozen=True)
class Log:
    """A recorded or simulated run of a robot.

    ``rig``: the robot and its sensors. ``world``: the map. ``streams``: the measurements, by the name of the sensor.
    ``reference``: the reference trajectory, or None. ``start``: the known start, or None. ``t0_ns``: absolute time of t
    = 0 [ns]. ``warnings``: problems that the reader corrected or skipped. ``metadata``: {key: text}, such as the
    licence, the origin, and columns that were not read.
    """

    name: str
    rig: Rig
    world: World
    streams: Mapping[str, Stream]
    reference: Trajectory | None = None
    start: StartPose | None = None
    t0_ns: int = 0
    warnings: tuple[Notice, ...] = ()
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", well_formed(self.name))  # a file name may contain invalid characters

    def __repr__(self) -> str:
        first, last = self.span()
        streams = ", ".join(f"{name} {len(stream.t)} rows" for name, stream in self.streams.items())
        return f"Log({self.name!r}, {last - first:.1f} s: {streams or 'no streams'})"

    def span(self) -> tuple[float, float]:
        """Return the first and the last timestamp [s] of all streams, or of the reference if there are no streams.
        Returns (0, 0) if there are no timestamps."""
        stamps = [(s.t.min(), s.t.max()) for s in self.streams.values() if len(s.t)]
        if not self.streams and self.reference:
            stamps = [(self.reference.t[0], self.reference.t[-1])]
        if not stamps:
            return 0.0, 0.0
        return float(min(a for a, _ in stamps)), float(max(b for _, b in stamps))

    def measurements(self, sensors: Sequence[str]) -> Iterator[Measurement]:
        """Yield the measurements of ``sensors`` (names) in order of arrival. The rig's time offsets are added. A
        measurement arrives at its timestamp, or at the timestamp of an earlier row of its stream if that is larger. At
        equal times, streams with a lower attribute ``rank`` are first."""

        return (m for _, _, _, m in heapq.merge(*self._arrivals(self._in_order(sensors))))

    def steps(self, sensors: Sequence[str]) -> Iterator[Measurement]:
        """Yield the measurements of ``sensors`` like :meth:`measurements`, but odometry in arrays, for speed.

        Consecutive rows of the first stream with the attribute ``joins`` are yielded in one
        :class:`~factorgraph_loc.model.measurement.Rows` object. It ends before the next measurement of another stream.
        A row that is older than the row before it is yielded alone.
        """
        order = self._in_order(sensors)
        joined = next((rank for rank, name in enumerate(order) if self.streams[name].joins), None)
        if joined is None:
            yield from self.measurements(sensors)
            return
        rows = self.streams[order[joined]].rows(self.rig.time_offset(order[joined]))
        arrived = np.maximum.accumulate(rows.times)
        late = np.flatnonzero(rows.times < arrived)
        first = 0
        for t, rank, _, m in heapq.merge(*self._arrivals(order, without=joined)):
            last = int(arrived.searchsorted(t, "right" if joined < rank else "left"))
            yield from _pieces(rows, late, first, last)
            first = last
            yield m
        yield from _pieces(rows, late, first, len(arrived))

    def alone(self, sensor: str) -> Log:
        """Return the log with ``sensor`` as the only sensor of its kind. The sensor is renamed to its kind. For example
        ``bearing_range.front`` becomes ``bearing_range``, and ``bearing_range.back`` is left out. Other kinds do not
        change. If ``sensor`` has no dot, the log is returned unchanged."""
        if kind_of(sensor) == sensor:
            return self
        streams = {name: self.streams[old] for name, old in as_only(self.streams, sensor).items()}
        return replace(self, rig=self.rig.alone(sensor), streams=streams)

    def _in_order(self, sensors: Sequence[str]) -> list[str]:
        """Return the names of the streams of ``sensors``, in the order of processing measurements with equal times."""
        return sorted((s for s in self.streams if s in sensors), key=lambda s: (self.streams[s].rank, s))

    def _arrivals(
        self, order: Sequence[str], without: int | None = None
    ) -> list[Iterator[tuple[float, int, int, Measurement]]]:
        """Return an iterator per stream in ``order`` over its measurements, as sortable tuples. ``without``: the index
        of a stream in ``order`` that is left out. A tuple has the time of arrival [s], the index of the stream, the
        index of the row, and the measurement."""

        def arrivals(rank: int, name: str) -> Iterator[tuple[float, int, int, Measurement]]:
            latest = -np.inf
            for i, m in enumerate(self.streams[name].measurements(self.rig.time_offset(name))):
                latest = max(latest, m.t)
                yield latest, rank, i, m

        return [arrivals(rank, name) for rank, name in enumerate(order) if rank != without]


def _pieces(rows: Rows, late: Integers, first: int, last: int) -> Iterator[Rows]:
    """Yield ``rows`` with the indices ``first`` to ``last`` - 1 in parts. A row with an index in ``late`` is one part.
    All rows between two such rows are also one part."""
    for i in late[late.searchsorted(first) : late.searchsorted(last)].tolist() if len(late) else ():
        if first < i:
            yield rows.part(first, i)
        yield rows.part(i, i + 1)
        first = i + 1
    if first < last:
        yield rows.part(first, last)


def cut(log: Log, start: float, end: float) -> Log:
    """Return the part of a log, and of its reference, with timestamps from ``start`` to before ``end`` [s].

    Timestamps do not change. Time offsets of sensors are not considered. The part has no known start pose. Its first
    odometry increment is the motion since the previous row of the whole log. Raises InputError if it is empty.
    """

    def inside(t: Array) -> NDArray[np.bool_]:
        return np.asarray((t >= start) & (t < end))

    streams = {name: selected(stream, inside(stream.t)) for name, stream in log.streams.items()}
    if not any(len(stream.t) for stream in streams.values()):
        first, last = log.span()
        raise InputError(
            f"{log.name}: has no measurements in {start:g} to {end:g} s, expected times in {first:g} to {last:g} s"
        )
    reference = log.reference
    if reference is not None:
        keep = inside(reference.t)
        covariances = None if reference.covariances is None else reference.covariances[keep]
        reference = replace(reference, t=reference.t[keep], poses=reference.poses[keep], covariances=covariances)
    return replace(log, streams=streams, reference=reference if reference and len(reference) else None, start=None)


def join(first: Log, second: Log, *, gap: float = 0.1) -> Log:
    """Return a log of a robot that was carried: ``second`` begins ``gap`` seconds after the end of ``first``.

    The timestamps of ``second`` are shifted, its poses are not changed, and its first odometry increment becomes zero.
    Start, metadata and absolute time are from ``first``. Raises InputError if rig, map or kind of odometry differ, or
    if ``gap`` <= 0.
    """
    if gap <= 0.0:
        raise InputError(f"the gap between {first.name} and {second.name} is {gap:g} s, expected more than 0")
    for what, same in (("rig", first.rig == second.rig), ("map", first.world == second.world)):
        if not same:
            raise InputError(f"{first.name} and {second.name} differ in their {what}, expected one robot in one map")
    shift = _extent(first)[1] + gap - _extent(second)[0]
    streams = dict(first.streams)
    for name, stream in second.streams.items():
        later = replace(stream, t=stream.t + shift).without_first_motion()
        streams[name] = joined(streams[name], later) if name in streams else later
    return replace(
        first,
        name=f"{first.name}+{second.name}",
        streams=streams,
        reference=_joined_references(first.reference, second.reference, shift),
        warnings=(*first.warnings, *second.warnings),
    )


def _joined_references(first: Trajectory | None, second: Trajectory | None, shift: float) -> Trajectory | None:
    """Return two reference trajectories joined to one, the second shifted by ``shift`` [s]. None if both are None.

    Covariances and headings are kept only if both references have them.
    """
    later = None if second is None else replace(second, t=second.t + shift)
    if first is None or later is None:
        return first or later
    covariances = None
    if first.covariances is not None and later.covariances is not None:
        covariances = np.concatenate((first.covariances, later.covariances))
    return Trajectory(
        np.concatenate((first.t, later.t)),
        np.concatenate((first.poses, later.poses)),
        covariances,
        first.has_heading and later.has_heading,
    )


def _extent(log: Log) -> tuple[float, float]:
    """Return the first and the last timestamp [s] of the streams and the reference of a log."""
    first, last = log.span()
    if log.reference is None or not len(log.reference):
        return first, last
    return min(first, float(log.reference.t[0])), max(last, float(log.reference.t[-1]))

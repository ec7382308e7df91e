"""Reads and misses of the antennas along the reference.

Rounds of an antenna at nearly the same pose are merged into k reads of n rounds, because they are correlated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.rfid.settings import RfidSettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.sensors.smoothed import REFERENCE_GAP
from factors import se2
from factors.rfid.detection import TagArray
from factors.se2 import Array

NEAR = 0.05  # m; closer rounds of an antenna are merged
TURNED = 0.05  # rad
MOST_ROUNDS = 20.0  # weight limit per pose; otherwise a robot at rest would outweigh its whole drive
MIN_ROUNDS = 100

Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Rounds:
    """K poses with antenna rounds, and T tags of the map that were read at least once in the log.

    ``t`` (K,) [s] and ``poses`` (K, 3) of the robot; ``antenna`` (K,): index in the rig; ``count`` (K,): weighted number of
    inventory rounds; ``hits`` (K, T): number of rounds that read each tag. ``tags``: as surveyed; ``names``: T EPCs. ``silent``:
    tags of the map that were never read.
    """

    log: str
    t: Array
    poses: Array
    antenna: Integers
    count: Array
    hits: Array
    tags: TagArray
    names: tuple[str, ...]
    silent: tuple[str, ...]

    def part(self, keep: NDArray[np.bool_]) -> Rounds:
        """The selected poses."""
        return replace(
            self,
            t=self.t[keep],
            poses=self.poses[keep],
            antenna=self.antenna[keep],
            count=self.count[keep],
            hits=self.hits[keep],
        )


def rounds_of(log: Log, settings: RfidSettings, *, merged: bool = True) -> Rounds:
    """The rounds of a log within the reference, without unknown EPCs and antennas.

    ``merged``: merge rounds at nearly the same pose. The pose is that at the middle of the reads. InputError if there are too few
    rounds or read tags.
    """
    stream = log.streams["rfid"]
    assert isinstance(stream, RfidStream)
    assert log.reference is not None
    keys = np.rec.fromarrays((stream.t, stream.round))
    first, inverse = np.unique(keys, return_index=True, return_inverse=True)[1:]
    read = np.array([bool(epc) for epc in stream.epc], dtype=bool)
    t = stream.t[first] + log.rig.time_offset("rfid") - _middle(stream.age, inverse, read, len(first))
    antennas = {name: i for i, name in enumerate(settings.all_antennas())}
    antenna = np.array([antennas.get(stream.antenna[i], -1) for i in first], dtype=np.int64)
    seen = {epc for epc in stream.epc if epc in log.world.tags}
    names = tuple(name for name in log.world.tags if name in seen)
    index = {name: i for i, name in enumerate(names)}
    hits = np.zeros((len(first), len(names)))
    columns = np.array([index.get(epc, -1) for epc in stream.epc], dtype=np.int64)
    known = columns >= 0
    hits[inverse[known], columns[known]] = 1.0
    order = np.argsort(t, kind="stable")
    poses = log.reference.at(t[order], max_gap=REFERENCE_GAP)
    order = order[np.isfinite(poses[:, 0]) & (antenna[order] >= 0)]
    if len(order) < MIN_ROUNDS or len(names) < 2:
        raise InputError(
            f"{log.name}: has {len(order)} inventory rounds of the rig's antennas within the reference, in which "
            f"{len(names)} tags of the map were read, expected {MIN_ROUNDS} rounds and 2 tags or more"
        )
    tags = [log.world.tags[name] for name in names]
    found = Rounds(
        log.name,
        t[order],
        log.reference.at(t[order], max_gap=REFERENCE_GAP),
        antenna[order],
        np.ones(len(order)),
        hits[order],
        TagArray(
            np.array([(tag.x, tag.y, tag.z) for tag in tags]),
            np.array([np.nan if tag.facing is None else tag.facing for tag in tags]),
        ),
        names,
        tuple(name for name in log.world.tags if name not in seen),
    )
    return _together(found) if merged else found


def distinct(logs: Sequence[Log]) -> list[int]:
    """An identifier of each log's reads, equal for logs with the same reads but other odometry."""
    streams: list[RfidStream] = []
    out = []
    for log in logs:
        stream = log.streams["rfid"]
        assert isinstance(stream, RfidStream)
        same = (
            i for i, one in enumerate(streams) if np.array_equal(one.t, stream.t) and list(one.epc) == list(stream.epc)
        )
        number = next(same, len(streams))
        if number == len(streams):
            streams.append(stream)
        out.append(number)
    return out


def _middle(age: Array, inverse: Integers, read: NDArray[np.bool_], count: int) -> Array:
    """Time (count,) from the middle of each round to its end; a typical one for rounds without reads."""
    oldest, youngest = np.full(count, -np.inf), np.full(count, np.inf)
    np.maximum.at(oldest, inverse[read], age[read])
    np.minimum.at(youngest, inverse[read], age[read])
    known = np.isfinite(oldest)
    middle = np.zeros(count)
    middle[known] = 0.5 * (oldest[known] + youngest[known])
    middle[~known] = np.median(middle[known]) if np.any(known) else 0.0
    return middle


def _together(rounds: Rounds) -> Rounds:
    group = np.zeros(len(rounds.t), dtype=np.int64)
    begun: dict[int, tuple[int, Array]] = {}
    count = 0
    for i, (antenna, pose) in enumerate(zip(rounds.antenna.tolist(), rounds.poses, strict=True)):
        number, start = begun.get(antenna, (-1, pose))
        away = np.hypot(pose[0] - start[0], pose[1] - start[1]) > NEAR
        if number < 0 or away or abs(se2.wrap_scalar(float(pose[2] - start[2]))) > TURNED:
            number, start = count, pose
            begun[antenna] = number, start
            count += 1
        group[i] = number
    size = np.bincount(group, minlength=count).astype(float)
    hits = np.zeros((count, rounds.hits.shape[1]))
    np.add.at(hits, group, rounds.hits)
    # the poses of a group are close together, so its middle represents all
    order = np.argsort(group, kind="stable")
    starts = np.concatenate(([0], np.cumsum(size.astype(np.int64))[:-1]))
    middle = order[starts + size.astype(np.int64) // 2]
    weight = np.minimum(1.0, MOST_ROUNDS / size)
    return replace(
        rounds,
        t=rounds.t[middle],
        poses=rounds.poses[middle],
        antenna=rounds.antenna[middle],
        count=weight * size,
        hits=weight[:, None] * hits,
    )

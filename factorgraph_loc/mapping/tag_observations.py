"""The tag reads of a log as counts per antenna and tag, with the known properties of the tags."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.rfid.known_tags import tag_map, whole_scans
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factorgraph_loc.sensors.rfid.stream import RfidScan
from factorgraph_loc.text import listed
from factors.rfid.detection import TagReadCounts
from factors.rfid.model import RfidModel
from factors.se2 import Array


@dataclass(frozen=True, eq=False)
class TagObservations:
    """K antenna observations of T tags, ordered by time. An observation is what one antenna read in some inventory rounds.

    ``names``: T EPCs; ``t`` (K,) [s]; ``antennas`` (K,): indices in the ``model``; ``rounds`` (K,); ``hits`` (K, T).
    ``heights`` (T,) [m], assumed if not ``has_height`` (T,); ``facing`` (T,) [rad] in the world, NaN where unknown; ``positions``
    (T, 2): from the log's map, NaN where it has none.
    """

    model: RfidModel
    names: tuple[str, ...]
    t: Array
    antennas: NDArray[np.int64]
    rounds: NDArray[np.int64]
    hits: NDArray[np.int64]
    heights: Array
    facing: Array
    positions: Array
    has_height: NDArray[np.bool_]

    def along(self, poses: Array, which: NDArray[np.bool_] | slice = slice(None)) -> TagReadCounts:
        """Read counts of the observations ``which``, from robot ``poses`` (K', 3) in the world, relative to the world's origin."""
        return TagReadCounts(poses, self.antennas[which], self.rounds[which], self.hits[which])


def tag_observations(log: Log, height: float | None = None) -> TagObservations:
    """All antenna observations of the tags that a log read or that its map contains.

    Heights and facings come from the map. For other tags the height is ``height`` [m], by default the mean height of the
    antennas, and the facing is unknown.

    Raises InputError if the log has no reads, or none by an antenna of its rig.
    """
    scans = whole_scans(log)
    read_tags = {epc for scan in scans for epc in scan.tags}
    if not read_tags:
        raise InputError(f"{log.name}: has no reads of tags (rfid), so that there is nothing to map")
    if log.rig.find(RfidSettings) is None:
        raise InputError(f"{log.name}: its rig has no [rfid], expected antennas and what they read")
    antennas = {name: i for i, name in enumerate(log.rig.of(RfidSettings).all_antennas())}
    model = log.rig.of(RfidSettings).model()
    given = tag_map(log.world, log.rig.of(SurveySettings))
    names = (*given.names, *sorted(read_tags - set(given.names)))
    index = {name: i for i, name in enumerate(names)}
    rows = [row for m in scans for row in _rows(m, antennas, index)]
    if not rows:
        known = listed(antennas)
        raise InputError(f"{log.name}: no antenna that read is in its rig, expected some of {known}")
    rows.sort(key=lambda row: row[0])
    t, antenna, rounds, hits = zip(*rows, strict=True)
    unmapped = len(names) - len(given.names)
    has_height = np.append(np.ones(len(given.names), dtype=bool), np.full(unmapped, height is not None))
    if height is None:
        height = float(np.mean([a.z for a in model.antennas]))
    return TagObservations(
        model,
        names,
        np.array(t),
        np.array(antenna, dtype=np.int64),
        np.array(rounds, dtype=np.int64),
        np.array(hits, dtype=np.int64),
        np.concatenate((given.tags.points[:, 2], np.full(unmapped, height))),
        np.concatenate((given.tags.facing, np.full(unmapped, np.nan))),
        np.concatenate((given.tags.points[:, :2], np.full((unmapped, 2), np.nan))),
        has_height,
    )


def _rows(
    m: RfidScan, antennas: dict[str, int], index: dict[str, int]
) -> list[tuple[float, int, int, NDArray[np.int64]]]:
    """Antenna observations of a scan: time, antenna, rounds, and hits (T,)."""
    places = [antennas.get(name, -1) for name in m.antennas]
    out = {a: (m.t, a, places.count(a), np.zeros(len(index), dtype=np.int64)) for a in sorted(set(places) - {-1})}
    # a tag counts once per round, even if it answers several times
    for number, name in dict.fromkeys(zip(m.antenna.tolist(), m.tags, strict=True)):
        if places[number] >= 0:
            out[places[number]][3][index[name]] += 1
    return list(out.values())

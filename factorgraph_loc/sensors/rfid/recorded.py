"""Semi-real reads: a virtual tag is read when a recorded one was, in a round at about the same range, bearing, height and facing.

What that keeps of a real antenna: its pattern, and that misses last while the robot passes a tag. What it does not: reflections at
places of the virtual world, that several antennas miss one tag at once, and anything that depends on pitch.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, RfidSettings, SurveySettings
from factorgraph_loc.sensors.rfid.tag_map import tag_map
from factorgraph_loc.sensors.rfid.whole import whole_scans
from factors import se2
from factors.rfid.detection import TagArray
from factors.se2 import Array

SCALES = np.array(
    (0.3, 0.26, 0.3, 0.3)
)  # of range [m], |bearing| [rad], height [m], facing's cosine: as far apart as alike
JITTER = 0.5  # of these scales: how far from its own place each antenna and tag looks for its donors
DONORS = 8  # rounds that one is drawn from
FAR = 2.0  # scales: a donor farther away than that is none
MAX_GAP = 0.5  # s, of the reference


@dataclass(frozen=True, eq=False)
class RecordedLooks:
    """L rounds of a recorded antenna, each with one tag: ``features`` (L, 4), in :data:`SCALES`, and whether it was ``read`` (L,).

    ``reach`` [m]: beyond it nothing was ever read. ``rfid``: the antennas that recorded them, and what is believed of them.
    """

    rfid: RfidSettings
    features: Array
    read: Array
    reach: float
    tree: cKDTree

    def carried_by(self, rig: Rig) -> Rig:
        """A rig with the recorded antennas, in a world that was surveyed without error."""
        return rig.model_copy(update={"rfid": self.rfid, "survey": SurveySettings()})

    def outcomes(self, tags: TagArray, poses: Array, rng: np.random.Generator) -> Array:
        """What a round of each antenna at poses (N, 3) reads of each tag: 0 or 1, (N, A, T).

        Each antenna and tag has its own place, :data:`JITTER` about the true one, around which its donors are: so neighbouring
        poses have neighbouring donors, mostly the same recorded tag on one pass, and different tags have different ones.
        """
        antennas = self.rfid.all_antennas()
        out = np.zeros((len(poses), len(antennas), len(tags.points)))
        for a, antenna in enumerate(antennas.values()):
            seen = _features(antenna, tags, poses)
            jitter = JITTER * rng.standard_normal(seen.shape[1:])
            near = seen[..., 0] * SCALES[0] <= self.reach
            _, donors = self.tree.query((seen + jitter)[near], k=DONORS)
            chosen = rng.integers(DONORS, size=len(donors))
            out[:, a][near] = self.read[donors[np.arange(len(donors)), chosen]]
        return out

    def unmatched(self, tags: TagArray, poses: Array) -> float:
        """Share of the looks within reach without a recorded one within :data:`FAR` scales."""
        antennas = self.rfid.all_antennas().values()
        seen = np.concatenate([_features(antenna, tags, poses).reshape(-1, 4) for antenna in antennas])
        near = seen[seen[:, 0] * SCALES[0] <= self.reach]
        if not len(near):
            return 0.0
        distance, _ = self.tree.query(near, k=1)
        return float((distance > FAR).mean())


def recorded_looks(logs: list[Log]) -> RecordedLooks:
    """What the antennas of ``logs`` read, and did not read, of the tags that they ever read.

    InputError if a log lacks the reference, the antennas, the tags, or their facings.
    """
    parts = [_looks(log) for log in logs]
    rfid = logs[0].rig.find(RfidSettings)
    assert rfid is not None, "that has been checked"
    features = np.concatenate([part[0] for part in parts])
    read = np.concatenate([part[1] for part in parts])
    if int(read.sum()) < DONORS:
        raise InputError(f"{logs[0].name}: has {int(read.sum())} reads of tags of its map, too few to draw from")
    reach = float((features[read > 0.0, 0] * SCALES[0]).max())
    keep = features[:, 0] * SCALES[0] <= reach + 1.0
    return RecordedLooks(rfid, features[keep], read[keep], reach, cKDTree(features[keep]))


def _looks(log: Log) -> tuple[Array, Array]:
    rfid, reference, stream = log.rig.find(RfidSettings), log.reference, log.streams.get("rfid")
    if rfid is None or reference is None or stream is None or not reference.has_heading:
        raise InputError(f"{log.name}: expected a log with rfid, antennas in its rig and a reference with headings")
    scans = whole_scans(log)
    tags = tag_map(log.world, log.rig.of(SurveySettings), {epc for scan in scans for epc in scan.tags})
    if not np.isfinite(tags.tags.facing).all():
        raise InputError(f"{log.name}: has tags without a facing, expected one of each to find like ones by")
    poses = reference.at(np.array([scan.t for scan in scans]), max_gap=MAX_GAP)
    features, reads = [], []
    for name, antenna in rfid.all_antennas().items():
        rows, hits = [], []
        for i, scan in enumerate(scans):
            if not np.isfinite(poses[i, 0]):
                continue
            for k, listening in enumerate(scan.antennas):
                if listening == name:
                    rows.append(i)
                    found = {
                        tags.index[scan.tags[j]]
                        for j in np.flatnonzero(scan.antenna == k)
                        if scan.tags[j] in tags.index
                    }
                    hits.append([float(t in found) for t in range(len(tags.names))])
        if rows:
            features.append(_features(antenna, tags.tags, poses[rows]).reshape(-1, 4))
            reads.append(np.array(hits).ravel())
    if not features:
        raise InputError(f"{log.name}: has no round of a known antenna while there is a reference")
    return np.concatenate(features), np.concatenate(reads)


def _features(antenna: AntennaSettings, tags: TagArray, poses: Array) -> Array:
    """Range, |bearing|, height and cosine of the facing (N, T, 4), in :data:`SCALES`, of tags from an antenna at poses (N, 3)."""
    placed = se2.compose(poses, np.array((antenna.x, antenna.y, antenna.yaw)))[:, None]
    local = se2.transform_to(placed, tags.points[None, :, :2])
    distance = np.hypot(local[..., 0], local[..., 1])
    away = tags.points[None, :, :2] - placed[..., :2]
    facing = -(tags.normals * away).sum(axis=-1) / np.maximum(distance, 1e-6)
    height = np.broadcast_to(tags.points[:, 2] - antenna.z, distance.shape)
    bearing = np.abs(np.arctan2(local[..., 1], local[..., 0]))
    return np.asarray(np.stack((distance, bearing, height, facing), axis=-1) / SCALES)

"""Semi-real reads: resampling of recorded reads at similar range, bearing, height and facing.

This preserves the real antenna pattern and that misses persist while the robot passes a tag. It does not preserve reflections,
simultaneous misses of several antennas, and effects of pitch.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.settings import AntennaSettings, RfidSettings, SurveySettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factors import se2
from factors.rfid.detection import TagArray
from factors.se2 import Array

SCALES = np.array(
    (0.3, 0.26, 0.3, 0.3)
)  # of range [m], |bearing| [rad], height [m], cosine of the facing: differences of equal importance
JITTER = 0.5  # of these scales; offset of the donors of each antenna and tag
DONORS = 8  # rounds to sample from
FAR = 2.0  # scales; maximum distance of a donor
MAX_GAP = 0.5  # s; of the reference


@dataclass(frozen=True, eq=False)
class RecordedLooks:
    """L rounds of a recorded antenna with one tag each: ``features`` (L, 4), in :data:`SCALES`, and whether it was ``read`` (L,).

    ``reach`` [m]: maximum range of reads. ``rfid``: settings of the recorded antennas.
    """

    rfid: RfidSettings
    features: Array
    read: Array
    reach: float
    tree: cKDTree

    def carried_by(self, rig: Rig) -> Rig:
        """A rig with the recorded antennas in a world without survey errors."""
        return rig.model_copy(update={"rfid": self.rfid, "survey": SurveySettings()})

    def outcomes(self, tags: TagArray, poses: Array, rng: np.random.Generator) -> Array:
        """Reads of each tag in a round of each antenna at poses (N, 3): 0 or 1, (N, A, T).

        Each antenna and tag has a fixed offset of size :data:`JITTER` at which its donors are searched. So neighbouring poses have
        neighbouring donors, mostly of one recorded tag and pass, and different tags have different donors.
        """
        antennas = self.rfid.all_antennas()
        out = np.zeros((len(poses), len(antennas), len(tags.points)))
        for a, antenna in enumerate(antennas.values()):
            features = _features(antenna, tags, poses)
            jitter = JITTER * rng.standard_normal(features.shape[1:])
            near = features[..., 0] * SCALES[0] <= self.reach
            _, donors = self.tree.query((features + jitter)[near], k=DONORS)
            chosen = rng.integers(DONORS, size=len(donors))
            out[:, a][near] = self.read[donors[np.arange(len(donors)), chosen]]
        return out

    def unmatched(self, tags: TagArray, poses: Array) -> float:
        """Share of the rounds within range that have no donor within :data:`FAR` scales."""
        antennas = self.rfid.all_antennas().values()
        features = np.concatenate([_features(antenna, tags, poses).reshape(-1, 4) for antenna in antennas])
        near = features[features[:, 0] * SCALES[0] <= self.reach]
        if not len(near):
            return 0.0
        distance, _ = self.tree.query(near, k=1)
        return float((distance > FAR).mean())


def recorded_looks(logs: list[Log]) -> RecordedLooks:
    """The reads and misses in ``logs`` of all tags that were read at least once.

    InputError if a log lacks the reference, the antennas, the tags, or their facings.
    """
    parts = [_looks(log) for log in logs]
    rfid = logs[0].rig.find(RfidSettings)
    assert rfid is not None, "that has been checked"
    features = np.concatenate([part[0] for part in parts])
    read = np.concatenate([part[1] for part in parts])
    if int(read.sum()) < DONORS:
        raise InputError(f"{logs[0].name}: has {int(read.sum())} reads of tags of its map, too few to resample")
    reach = float((features[read > 0.0, 0] * SCALES[0]).max())
    keep = features[:, 0] * SCALES[0] <= reach + 1.0
    return RecordedLooks(rfid, features[keep], read[keep], reach, cKDTree(features[keep]))


def _looks(log: Log) -> tuple[Array, Array]:
    rfid, reference, stream = log.rig.find(RfidSettings), log.reference, log.streams.get("rfid")
    if rfid is None or reference is None or not isinstance(stream, RfidStream) or not reference.has_heading:
        raise InputError(f"{log.name}: expected a log with rfid, antennas in its rig and a reference with headings")
    tags = tag_map(log.world, log.rig.of(SurveySettings), set(stream.epc))
    if not np.isfinite(tags.tags.facing).all():
        raise InputError(f"{log.name}: has tags without a facing, which resampling needs")
    first, hits = stream.first_rows, stream.hits(tags.index)
    poses = reference.at(stream.t[first] + log.rig.time_offset("rfid"), max_gap=MAX_GAP)
    listening = np.array(stream.antenna, dtype=str)[first]
    features, reads = [], []
    for name, antenna in rfid.all_antennas().items():
        rows = np.flatnonzero(np.isfinite(poses[:, 0]) & (listening == name))
        if len(rows):
            features.append(_features(antenna, tags.tags, poses[rows]).reshape(-1, 4))
            reads.append(hits[rows].astype(float).ravel())
    if not features:
        raise InputError(f"{log.name}: has no round of a known antenna within the reference")
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

"""Reads that were observed against reads that were predicted, along the final trajectory of a run, by distance and antenna.

A reliability diagram (DeGroot and Fienberg, "The comparison and evaluation of forecasters", The Statistician 32, 1983) of a
detection model on the log at hand. Reads and misses of one tag by one antenna follow each other with the same reflections and the
same obstacles. How much more they scatter than independent ones over some seconds gives the variance of all counts (McCullagh and
Nelder, "Generalized linear models", 1989, section 4.5).
"""

from dataclasses import dataclass

import numpy as np

from factorgraph_loc.model.belief import Learnt
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.reliability import Reliability
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.interfaces import Use
from factorgraph_loc.sensors.rfid.consistency import BAND, DIFFERENT, FEWEST, ReadGroups
from factorgraph_loc.sensors.rfid.monitor import BLOCK, POSSIBLE
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.sensors.rfid.tag_map import tag_map
from factorgraph_loc.sensors.smoothed import REFERENCE_GAP, possible_poses
from factors.rfid.detection import ExpectedReads, RfidLikelihood
from factors.se2 import Array, Integers, transform_from

MOST_ROUNDS = 6000  # of a long log so many are looked at, evenly spread
CLEARLY = 4.0  # standard deviations above which a group that is off is doubted
TOGETHER = 2.0  # rounds that count as one: more is told, as estimators take `1 / tempering` for it


@dataclass(frozen=True, eq=False)
class _Looks:
    """M rounds of an antenna at a tag that it may have read: probability ``p`` and ``hit`` (M,); ``antenna``, ``tag``, ``block``
    (M,) of time; ``distance`` (M,) [m]."""

    p: Array
    hit: Array
    antenna: Integers
    tag: Integers
    block: Integers
    distance: Array


def reliability(use: Use, diagnostics: Diagnostics, learnt: Learnt, final: Trajectory) -> Reliability | None:
    """The reliability of the detection models with what was learnt of them; None without reads, antennas or covariances.

    Tags that are believed dead or moved are left out, and times in which nothing was read.
    """
    log, settings = use.log, use.log.rig.find(RfidSettings)
    stream = log.streams.get("rfid")
    if settings is None or "rfid" not in use.sensors or not isinstance(stream, RfidStream) or not len(stream.t):
        return None
    if not log.world.tags or len(final) < 2 or final.covariances is None or "rfid" not in use.modalities:
        return None
    doubted = diagnostics.dead_tags.keys() | diagnostics.moved_tags.keys()
    kept = [name for name in log.world.tags if name not in doubted]
    looks = _looks(use, stream, settings, learnt, final, kept)
    if looks is None:
        return None
    names = list(settings.all_antennas())
    return _told(log.name, looks, names, settings.tempering)


def _looks(
    use: Use, stream: RfidStream, settings: RfidSettings, learnt: Learnt, final: Trajectory, kept: list[str]
) -> _Looks | None:
    log, tags = use.log, tag_map(use.log.world, use.log.rig.of(SurveySettings), kept)
    likelihood = RfidLikelihood(settings.model(), tags.tags)
    estimated = settings.estimated()
    found = np.array([learnt.values.get(f"rfid.{name}", (0.0, 0.0))[0] for name in estimated.names])
    likelihood = likelihood.adjusted(estimated.full(found, len(likelihood.parameters)))
    first, inverse = np.unique(np.rec.fromarrays((stream.t, stream.round)), return_index=True, return_inverse=True)[1:]
    t = stream.t[first] + log.rig.time_offset("rfid")
    block = ((t - t.min()) // BLOCK).astype(np.int64)
    read = np.array([epc in tags.index for epc in stream.epc], dtype=bool)
    heard = np.zeros(int(block.max()) + 1, dtype=bool)
    heard[block[inverse[read]]] = True
    numbers = {name: i for i, name in enumerate(settings.all_antennas())}
    antenna = np.array([numbers.get(stream.antenna[i], -1) for i in first.tolist()], dtype=np.int64)
    poses = possible_poses(final, t, REFERENCE_GAP)
    used = np.isfinite(poses[:, 0]) & (antenna >= 0) & heard[block]
    used[np.flatnonzero(used)[_left_out(int(used.sum()))]] = False
    rows = np.flatnonzero(read)
    place = np.array([tags.index[stream.epc[i]] for i in rows.tolist()], dtype=np.int64)
    parts = []
    for a, mounted in enumerate(settings.all_antennas().values()):
        mine = np.flatnonzero(used & (antenna == a))
        if not len(mine):
            continue
        p = likelihood.probabilities(poses[mine], a)
        row_of = np.full(len(first), -1, dtype=np.int64)
        row_of[mine] = np.arange(len(mine))
        hits = np.zeros(p.shape, dtype=bool)
        ours = row_of[inverse[rows]] >= 0
        hits[row_of[inverse[rows[ours]]], place[ours]] = True
        n, tag = np.nonzero(p > POSSIBLE)
        at = np.array([transform_from(pose, np.array((mounted.x, mounted.y))) for pose in poses[mine]])
        distance = np.hypot(*(tags.tags.points[tag, :2] - at[n]).T)
        parts.append((p[n, tag], hits[n, tag].astype(float), np.full(len(n), a), tag, block[mine][n], distance))
    if not parts:
        return None
    return _Looks(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _left_out(count: int) -> Integers:
    """Of so many rounds, those that are more than :data:`MOST_ROUNDS` are."""
    kept = np.unique(np.linspace(0, count - 1, min(count, MOST_ROUNDS)).astype(np.int64)) if count else np.empty(0, int)
    return np.setdiff1d(np.arange(count), kept)


def _told(log: str, looks: _Looks, antennas: list[str], tempering: float) -> Reliability | None:
    """The counts by bands of distance and by antennas, None if there are too few."""
    if looks.p.sum() < FEWEST:
        return None
    groups = ReadGroups(antennas)
    one = np.ones(len(looks.p), dtype=np.int64)
    reads = ExpectedReads(looks.tag, looks.hit.astype(np.int64)[:, None], looks.p[:, None], looks.distance[:, None])
    groups.add(looks.antenna, one, reads, one[:, None] > 0)
    together, told = _together(looks, (looks.distance // BAND).astype(np.int64)), groups.told()
    if not len(told):
        return None
    observed, predicted, variance = groups.sums[:, told]
    # what the estimators take successive rounds for is no reason to doubt the model either
    spread = np.sqrt(max(together, 1.0 / tempering) * variance)
    off = (np.abs(observed - predicted) > CLEARLY * spread) & (np.abs(observed / predicted - 1.0) > DIFFERENT)
    doubts = []
    if np.any(off):
        shares = groups.shares(told[off])
        doubts.append(f"{log}: reads over those that the detection models predict, by distance and antenna: {shares}")
    if together * tempering > TOGETHER:
        doubts.append(
            f"{log}: reads and misses come in bursts, {together:.0f} rounds tell as much as one; the tempering in the rig is "
            f"{tempering:g}"
        )
    return Reliability("reads", groups.names(told), observed, predicted, spread, together, tuple(doubts))


def _together(looks: _Looks, band: Integers) -> float:
    """How many rounds are worth an independent one, at least 1: by the scatter of each tag's reads by each antenna in blocks of
    time, about the share of the predicted reads that the band has."""
    share = np.ones(int(band.max(initial=0)) + 1)
    predicted, observed = np.bincount(band, looks.p), np.bincount(band, looks.hit)
    np.divide(observed, predicted, out=share, where=predicted > 0.0)
    p = np.clip(looks.p * share[band], 0.0, 1.0 - 1e-3)
    key = (looks.block * (looks.tag.max(initial=0) + 1) + looks.tag) * (
        looks.antenna.max(initial=0) + 1
    ) + looks.antenna
    cell = np.unique(key, return_inverse=True)[1]
    excess, variance = np.bincount(cell, looks.hit - p), np.bincount(cell, p * (1.0 - p))
    return max(1.0, float(np.sum(excess**2)) / max(float(np.sum(variance)), 1e-9))

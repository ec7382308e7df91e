"""Data for the fit of detection models: pairs of an active antenna and a tag, with position of the tag and number of reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.sensors.rfid.calibration.rounds import Integers, Rounds
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factors import se2
from factors.rfid.model import NEGLIGIBLE_LOGIT, DetectionModel, logits
from factors.se2 import Array

REACH = 8.0  # m; largest distance in the plane of a pair, which is also the range of a logistic model
BLOCK = 20.0  # s; reads in the same block of time may be correlated
BLOCKS = 4  # number of folds if there is only one log; otherwise each log is a fold


@dataclass(frozen=True, eq=False)
class TagPairs:
    """M pairs of an antenna at one pose and a tag.

    ``points`` (M, 3): positions of the tags in the antenna's frame [m].
    ``facing`` (M,): cosine of the angle between the tag's facing and the direction to the antenna, 0 if unknown.
    ``hits``, ``count`` (M,): number of rounds that read the tag, and number of rounds.
    ``antenna``, ``tag`` (M,): index of the antenna in the rig, and of the tag among all logs.
    ``fold`` (M,): number of the fold for cross-validation. ``block`` (M,): number of the block of time.
    """

    points: Array
    facing: Array
    hits: Array
    count: Array
    antenna: Integers
    tag: Integers
    fold: Integers
    block: Integers

    def part(self, keep: NDArray[np.bool_] | Integers) -> TagPairs:
        """Return the selected pairs."""
        return replace(self, **{f.name: getattr(self, f.name)[keep] for f in fields(self)})


@dataclass(frozen=True, eq=False)
class Terms:
    """The likelihood of M pairs, each field (M,): the negative log-likelihood, its derivative by the logit, and the
    Fisher information on the logit."""

    nll: Array
    gradient: Array
    information: Array


def pairs_of(
    logs: Sequence[Rounds],
    settings: RfidSettings,
    survey: SurveySettings,
    within: Sequence[Integers] | None = None,
    length: float = BLOCK,
) -> TagPairs:
    """Return the pairs of antenna and tag of several logs.

    ``survey``: the transform of the tags' positions. ``within``: for each log the flat indices (round, tag) of the
    pairs, None for all pairs within :data:`REACH`. ``length``: length of the blocks of time [s].
    """
    numbers = {name: i for i, name in enumerate(dict.fromkeys(name for log in logs for name in log.names))}
    parts = []
    blocks = 0
    for i, log in enumerate(logs):
        chosen = nearby(log, settings, survey) if within is None else within[i]
        coordinates, _ = view_of(log, settings, survey, chosen)
        row, column = np.divmod(chosen, len(log.names))
        seconds = log.t - log.t.min()
        block = (seconds // length).astype(np.int64) + blocks
        blocks = int(block.max()) + 1
        fold = np.full(len(log.t), i)
        if len(logs) == 1:
            fold = np.minimum(BLOCKS * seconds / max(float(seconds.max()), 1e-9), BLOCKS - 1).astype(np.int64)
        tag = np.array([numbers[name] for name in log.names])[column]
        hits, count, antenna = log.hits.ravel()[chosen], log.count[row], log.antenna[row]
        parts.append(TagPairs(coordinates[:, :3], coordinates[:, 3], hits, count, antenna, tag, fold[row], block[row]))
    return TagPairs(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(TagPairs)})


def nearby(log: Rounds, settings: RfidSettings, survey: SurveySettings) -> Integers:
    """Return the flat indices (round, tag) of the pairs of antenna and tag that are closer than :data:`REACH`."""
    every = np.arange(log.hits.size)
    return every[view_of(log, settings, survey, every)[1] < REACH]


def view_of(log: Rounds, settings: RfidSettings, survey: SurveySettings, pairs: Integers) -> tuple[Array, Array]:
    """Return the geometry of the pairs of a log with flat indices ``pairs`` (M,) of round and tag.

    Returns coordinates (M, 4), which are the tag's position in the antenna's frame [m] and its facing as in
    :class:`TagPairs`, and the distance (M,) of antenna and tag in the plane [m].
    """
    row, column = np.divmod(pairs, len(log.names))
    transform = survey.transform()
    tag = se2.transform_from(transform, log.tags.points[:, :2])[column]
    mounted = np.array([(a.x, a.y, a.yaw, a.z, a.pitch) for a in settings.all_antennas().values()])[log.antenna]
    antenna = se2.compose(log.poses, mounted[:, :3])[row]
    away = tag - antenna[:, :2]
    distance = np.hypot(*away.T)
    known = np.isfinite(log.tags.facing)
    angle = np.where(known, log.tags.facing, 0.0) + transform[2]
    normal = (known * np.stack((np.cos(angle), np.sin(angle)))).T[column]
    facing = -np.sum(normal * away, axis=1) / np.sqrt(distance**2 + 1e-9)
    c, s = np.cos(antenna[:, 2]), np.sin(antenna[:, 2])
    along, across = c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]
    height, pitch = log.tags.points[column, 2] - mounted[row, 3], mounted[row, 4]
    c, s = np.cos(pitch), np.sin(pitch)
    return np.column_stack((c * along + s * height, across, c * height - s * along, facing)), distance


@dataclass(frozen=True)
class Floor:
    """Lower bounds of two probabilities at any position of a tag: ``false_read`` of the probability of a read, and
    ``miss`` of the probability of a miss."""

    false_read: float = 0.02
    miss: float = 0.02

    def probability(self, logit: Array) -> Array:
        """Return the probability of a read for logits of a detection model."""
        sigmoid = 1.0 / (1.0 + np.exp(-np.maximum(logit, NEGLIGIBLE_LOGIT)))
        return np.asarray(self.false_read + (1.0 - self.false_read - self.miss) * sigmoid)


def terms(logit: Array, hits: Array, count: Array, floor: Floor) -> Terms:
    """Return the likelihood of ``hits`` (M,) in ``count`` (M,) rounds with logits (M,). ``floor``: probabilities of
    false reads and misses, see :mod:`factors.rfid.model`."""
    q = np.clip(floor.probability(logit), 1e-12, 1.0 - 1e-12)
    by_logit = (q - floor.false_read) * (1.0 - floor.miss - q) / (1.0 - floor.false_read - floor.miss)
    return Terms(
        -(hits * np.log(q) + (count - hits) * np.log1p(-q)),
        -(hits / q - (count - hits) / (1.0 - q)) * by_logit,
        count * by_logit**2 / (q * (1.0 - q)),
    )


def modelled(models: Sequence[DetectionModel], which: Sequence[int], pairs: TagPairs) -> Array:
    """Return the logits (M,) of ``pairs`` by detection models. Antenna i has the model ``models[which[i]]``."""
    out = np.empty(len(pairs.facing))
    mine = np.asarray(which)[pairs.antenna]
    for i, model in enumerate(models):
        out[mine == i] = logits(model, pairs.points[mine == i], pairs.facing[mine == i])[0]
    return out

"""Pairs of an active antenna and a tag: position of the tag in the antenna's frame, and number of reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.sensors.rfid.calibration.rounds import Integers, Rounds
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factors import se2
from factors.rfid.model import NEGLIGIBLE_LOGIT, DetectionModel, logits
from factors.se2 import Array

REACH = 8.0  # m in the plane; the range of a logistic model
BLOCK = 20.0  # s; reads within a block may be correlated
BLOCKS = 4  # folds of a single log


@dataclass(frozen=True, eq=False)
class TagPairs:
    """M pairs. ``points`` (M, 3) [m] in the antenna's frame; ``facing`` (M,): cosine of the angle between the tag's facing and the
    direction to the antenna, 0 if unknown; ``hits`` of ``count`` (M,) rounds; ``antenna`` (M,): index in the rig; ``tag`` (M,):
    index among all logs; ``fold`` (M,): held out jointly; ``block`` (M,): of :data:`BLOCK` seconds."""

    points: Array
    facing: Array
    hits: Array
    count: Array
    antenna: Integers
    tag: Integers
    fold: Integers
    block: Integers

    def part(self, keep: NDArray[np.bool_] | Integers) -> TagPairs:
        """The selected pairs."""
        return replace(self, **{f.name: getattr(self, f.name)[keep] for f in fields(self)})


@dataclass(frozen=True, eq=False)
class Terms:
    """For M pairs: negative log-likelihood, its derivative by the logit, and the Fisher information on the logit."""

    nll: Array
    gradient: Array
    information: Array


def pairs_of(
    logs: Sequence[Rounds], settings: RfidSettings, survey: SurveySettings, within: Sequence[Integers] | None = None
) -> TagPairs:
    """The pairs of several logs within :data:`REACH`, or those of ``within``: flat indices (round, tag) per log."""
    single = len(logs) == 1
    names = tag_names(logs)
    parts = []
    blocks = 0
    for i, log in enumerate(logs):
        chosen = nearby(log, settings, survey) if within is None else within[i]
        view = seen(log, settings, survey, chosen)
        row, column = np.divmod(chosen, len(log.names))
        block = ((log.t - log.t.min()) // BLOCK).astype(np.int64) + blocks
        blocks = int(block.max()) + 1
        fold = stretches(log.t) if single else np.full(len(log.t), i, dtype=np.int64)
        tag = np.array([names[name] for name in log.names], dtype=np.int64)
        hits, count = log.hits.ravel()[chosen], log.count[row]
        parts.append(
            TagPairs(view.points, view.facing, hits, count, log.antenna[row], tag[column], fold[row], block[row])
        )
    return TagPairs(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(TagPairs)})


def nearby(log: Rounds, settings: RfidSettings, survey: SurveySettings) -> Integers:
    """Flat indices (round, tag) of the pairs of a log within :data:`REACH`."""
    every = np.arange(log.hits.size)
    return every[seen(log, settings, survey, every).distance < REACH]


def tag_names(logs: Sequence[Rounds]) -> dict[str, int]:
    """An index for each tag of several logs."""
    return {name: i for i, name in enumerate(dict.fromkeys(name for log in logs for name in log.names))}


def stretches(t: Array) -> Integers:
    """The fold (N,) of each time of a single log, of :data:`BLOCKS` segments."""
    share = (t - t.min()) / max(float(np.ptp(t)), 1e-9)
    return np.asarray(np.minimum(BLOCKS * share, BLOCKS - 1).astype(np.int64))


class PairView(NamedTuple):
    """Pairs of a log, M antennas and tags: vector ``away`` (M, 2) from antenna to tag in the world, ``distance`` (M,) in the
    plane, and ``along`` and ``across`` (M,) the boresight. ``antenna`` (M, 3): pose in the world; ``mounted`` (M, 5): x, y, yaw, z,
    pitch on the robot; ``tag`` (M, 2) in the world; ``normal`` (M, 2): direction that it faces, zero if unknown; ``height`` (M,)
    above the antenna."""

    away: Array
    distance: Array
    along: Array
    across: Array
    antenna: Array
    mounted: Array
    tag: Array
    normal: Array
    height: Array

    @property
    def points(self) -> Array:
        """The tags (M, 3) in the antennas' frames."""
        cp, sp = np.cos(self.mounted[:, 4]), np.sin(self.mounted[:, 4])
        return np.column_stack((cp * self.along + sp * self.height, self.across, cp * self.height - sp * self.along))

    @property
    def facing(self) -> Array:
        """Cosines (M,) of the angle between the tag's facing and the direction to the antenna."""
        return np.asarray(-np.sum(self.normal * self.away, axis=1) / np.sqrt(self.distance**2 + 1e-9))

    def jacobian(self, gradient: Array, pivot: Array) -> Array:
        """Derivatives (M, 6) of logits by x, y, heading of the survey about ``pivot`` (2,), and by x, y, yaw of the mounting, from
        their ``gradient`` (M, 4) by points and facing."""
        cp, sp = np.cos(self.mounted[:, 4]), np.sin(self.mounted[:, 4])
        ahead, aside = cp * gradient[:, 0] - sp * gradient[:, 2], gradient[:, 1]
        c, s = np.cos(self.antenna[:, 2]), np.sin(self.antenna[:, 2])
        squared = self.distance**2 + 1e-9
        by_away = np.column_stack((c * ahead - s * aside, s * ahead + c * aside))
        by_away -= gradient[:, 3:] * (
            self.normal / np.sqrt(squared)[:, None] + (self.facing / squared)[:, None] * self.away
        )
        lever = self.tag - pivot
        turned = self.normal[:, 1] * self.away[:, 0] - self.normal[:, 0] * self.away[:, 1]
        by_heading = (
            by_away[:, 1] * lever[:, 0] - by_away[:, 0] * lever[:, 1] + gradient[:, 3] * turned / np.sqrt(squared)
        )
        robot = self.antenna[:, 2] - self.mounted[:, 2]
        c, s = np.cos(robot), np.sin(robot)
        by_x, by_y = -(c * by_away[:, 0] + s * by_away[:, 1]), s * by_away[:, 0] - c * by_away[:, 1]
        by_yaw = ahead * self.across - aside * self.along
        return np.column_stack((by_away, by_heading, by_x, by_y, by_yaw))


def seen(log: Rounds, settings: RfidSettings, survey: SurveySettings, pairs: Integers) -> PairView:
    """The pairs of a log with flat indices ``pairs`` (M,) of round and tag."""
    row, column = np.divmod(pairs, len(log.names))
    transform = survey.transform()
    tag = se2.transform_from(transform, log.tags.points[:, :2])[column]
    mounted = np.array([(a.x, a.y, a.yaw, a.z, a.pitch) for a in settings.all_antennas().values()])[log.antenna]
    antenna = se2.compose(log.poses, mounted[:, :3])[row]
    away = tag - antenna[:, :2]
    known = np.isfinite(log.tags.facing)
    angle = np.where(known, log.tags.facing, 0.0) + transform[2]
    normal = (known * np.stack((np.cos(angle), np.sin(angle)))).T[column]
    c, s = np.cos(antenna[:, 2]), np.sin(antenna[:, 2])
    along, across = c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]
    height = log.tags.points[column, 2] - mounted[row, 3]
    return PairView(away, np.hypot(*away.T), along, across, antenna, mounted[row], tag, normal, height)


@dataclass(frozen=True)
class Floor:
    """Probabilities of a false read, and of a miss at any position."""

    false_read: float = 0.02
    miss: float = 0.02

    def probability(self, logit: Array) -> Array:
        """The probability of a read."""
        sigmoid = 1.0 / (1.0 + np.exp(-np.maximum(logit, NEGLIGIBLE_LOGIT)))
        return np.asarray(self.false_read + (1.0 - self.false_read - self.miss) * sigmoid)


def terms(logit: Array, hits: Array, count: Array, floor: Floor) -> Terms:
    """The likelihood of ``hits`` in ``count`` rounds, with a floor for false reads and misses (see :mod:`factors.rfid.model`)."""
    q = np.clip(floor.probability(logit), 1e-12, 1.0 - 1e-12)
    by_logit = (q - floor.false_read) * (1.0 - floor.miss - q) / (1.0 - floor.false_read - floor.miss)
    return Terms(
        -(hits * np.log(q) + (count - hits) * np.log1p(-q)),
        -(hits / q - (count - hits) / (1.0 - q)) * by_logit,
        count * by_logit**2 / (q * (1.0 - q)),
    )


def modelled(models: Sequence[DetectionModel], which: Sequence[int], pairs: TagPairs) -> Array:
    """Logits (M,): antenna i has the model ``which[i]`` of ``models``."""
    if len(models) == 1:
        return logits(models[0], pairs.points, pairs.facing)[0]
    out = np.empty(len(pairs.facing))
    mine = np.asarray(which)[pairs.antenna]
    for i, model in enumerate(models):
        out[mine == i] = logits(model, pairs.points[mine == i], pairs.facing[mine == i])[0]
    return out

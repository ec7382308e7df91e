"""Data for the fit of detection models: pairs of an antenna pose and a tag, with the number of reads."""

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

REACH = 8.0  # m; maximum horizontal distance from an antenna to a tag, also for logistic models
BLOCK = 20.0  # s; length of time blocks; reads in the same block may be correlated
BLOCKS = 4  # number of folds for cross-validation if there is only one log; otherwise each log is a fold


@dataclass(frozen=True, eq=False)
class TagPairs:
    """M pairs of an antenna pose and a tag, with the number of reads. Detection models are fitted to them.

    ``points`` (M, 3): position of the tag in the antenna frame [m].
    ``facing`` (M,): cosine of the angle between the direction of the tag's front and the direction to the antenna, or
    0.
    ``count`` (M,): number of inventory rounds. ``hits`` (M,): number of rounds that read the tag.
    ``antenna``, ``tag`` (M,): index of the antenna in the rig, and of the tag among all logs.
    ``fold`` (M,): index of the fold for cross-validation. ``block`` (M,): index of the time block.
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
        """Return the selected pairs. ``keep``: a mask (M,) or the indices of the pairs."""
        return replace(self, **{f.name: getattr(self, f.name)[keep] for f in fields(self)})


@dataclass(frozen=True, eq=False)
class Terms:
    """The likelihood of M pairs of an antenna pose and a tag. ``nll`` (M,): negative log-likelihood. ``gradient`` (M,):
    its derivative by the logit of the read probability. ``information`` (M,): Fisher information on this logit."""

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
    """Return all pairs of an antenna pose and a tag nearby in several logs, with their reads.

    ``settings``: mounting of the antennas. ``survey``: the transform of the tags to the world frame. ``within``: the
    result of :func:`nearby` for each log, None to compute it. ``length``: length of the time blocks [s].
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
    """Return the indices (M,) of all pairs of a round and a tag with a distance below :data:`REACH`. The pair of round
    k and tag t of T tags has the index k T + t. ``survey``: the transform of the tags to the world frame."""
    every = np.arange(log.hits.size)
    return every[view_of(log, settings, survey, every)[1] < REACH]


def view_of(log: Rounds, settings: RfidSettings, survey: SurveySettings, pairs: Integers) -> tuple[Array, Array]:
    """Return the position and facing (M, 4) of the tag in M pairs, and the horizontal distance (M,) from antenna to tag
    [m].

    The columns are x, y, z of the tag in the antenna frame [m], and the cosine of an angle. The angle is that between
    the direction of the tag's front and the direction to the antenna. ``pairs`` (M,): indices of pairs, from
    :func:`nearby`.
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
    """The bounds of the probability of a read. ``false_read``: the minimum probability of a read, at any position of
    the tag. ``miss``: the minimum probability that a tag is not read."""

    false_read: float = 0.02
    miss: float = 0.02

    def probability(self, logit: Array) -> Array:
        """Return the probability (M,) of a read, within the bounds, for ``logit`` (M,) of a detection model."""
        sigmoid = 1.0 / (1.0 + np.exp(-np.maximum(logit, NEGLIGIBLE_LOGIT)))
        return np.asarray(self.false_read + (1.0 - self.false_read - self.miss) * sigmoid)


def terms(logit: Array, hits: Array, count: Array, floor: Floor) -> Terms:
    """Return the binomial likelihood of ``hits`` (M,) reads in ``count`` (M,) rounds, with derivatives. ``logit`` (M,):
    logits of the read probability by a detection model. ``floor``: minimum probabilities of a read and of a miss."""
    q = np.clip(floor.probability(logit), 1e-12, 1.0 - 1e-12)
    by_logit = (q - floor.false_read) * (1.0 - floor.miss - q) / (1.0 - floor.false_read - floor.miss)
    return Terms(
        -(hits * np.log(q) + (count - hits) * np.log1p(-q)),
        -(hits / q - (count - hits) / (1.0 - q)) * by_logit,
        count * by_logit**2 / (q * (1.0 - q)),
    )


def modelled(models: Sequence[DetectionModel], which: Sequence[int], pairs: TagPairs) -> Array:
    """Return the logits (M,) of the read probability that ``models`` predict for M ``pairs`` of an antenna pose and a
    tag. ``which``: the index in ``models`` for each antenna."""
    out = np.empty(len(pairs.facing))
    mine = np.asarray(which)[pairs.antenna]
    for i, model in enumerate(models):
        out[mine == i] = logits(model, pairs.points[mine == i], pairs.facing[mine == i])[0]
    return out

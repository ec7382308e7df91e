"""Pairs of an active antenna and a tag: position of the tag in the antenna's frame, and number of reads."""

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
    """The pairs of several logs within :data:`REACH`, or those of ``within``: flat indices (antenna, tag) per log."""
    single = len(logs) == 1
    names = tag_names(logs)
    parts = []
    blocks = 0
    for i, log in enumerate(logs):
        points, facing, _ = local(log, settings, survey)
        chosen = nearby(log, settings, survey) if within is None else within[i]
        row, column = np.divmod(chosen, len(log.names))
        block = ((log.t - log.t.min()) // BLOCK).astype(np.int64) + blocks
        blocks = int(block.max()) + 1
        fold = stretches(log.t) if single else np.full(len(log.t), i, dtype=np.int64)
        tag = np.array([names[name] for name in log.names], dtype=np.int64)
        parts.append(
            TagPairs(
                points.reshape(-1, 3)[chosen],
                facing.ravel()[chosen],
                log.hits.ravel()[chosen],
                log.count[row],
                log.antenna[row],
                tag[column],
                fold[row],
                block[row],
            )
        )
    return TagPairs(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(TagPairs)})


def nearby(log: Rounds, settings: RfidSettings, survey: SurveySettings) -> Integers:
    """Flat indices (antenna, tag) of the pairs of a log within :data:`REACH`."""
    return np.flatnonzero(local(log, settings, survey)[2].ravel() < REACH)


def tag_names(logs: Sequence[Rounds]) -> dict[str, int]:
    """An index for each tag of several logs."""
    return {name: i for i, name in enumerate(dict.fromkeys(name for log in logs for name in log.names))}


def stretches(t: Array) -> Integers:
    """The fold (N,) of each time of a single log, of :data:`BLOCKS` segments."""
    share = (t - t.min()) / max(float(np.ptp(t)), 1e-9)
    return np.asarray(np.minimum(BLOCKS * share, BLOCKS - 1).astype(np.int64))


def local(log: Rounds, settings: RfidSettings, survey: SurveySettings) -> tuple[Array, Array, Array]:
    """Tags in the antennas' frames (K, T, 3), cosines of their facing (K, T), and distances in the plane (K, T)."""
    transform = survey.transform()
    tags = se2.transform_from(transform, log.tags.points[:, :2])
    mounted = np.array([(a.x, a.y, a.yaw, a.z, a.pitch) for a in settings.all_antennas().values()])[log.antenna]
    antennas = se2.compose(log.poses, mounted[:, :3])
    away = tags[None] - antennas[:, None, :2]
    distance = np.hypot(away[..., 0], away[..., 1])
    known = np.isfinite(log.tags.facing)
    angle = np.where(known, log.tags.facing, 0.0) + transform[2]
    facing = -(np.cos(angle) * away[..., 0] + np.sin(angle) * away[..., 1]) / np.sqrt(distance**2 + 1e-9) * known
    c, s = np.cos(antennas[:, 2:]), np.sin(antennas[:, 2:])
    along, across = c * away[..., 0] + s * away[..., 1], c * away[..., 1] - s * away[..., 0]
    height = log.tags.points[None, :, 2] - mounted[:, 3:4]
    cp, sp = np.cos(mounted[:, 4:]), np.sin(mounted[:, 4:])
    return np.stack((cp * along + sp * height, across, cp * height - sp * along), axis=-1), facing, distance


def terms(logit: Array, hits: Array, count: Array, false_read: float, miss: float) -> Terms:
    """The likelihood of ``hits`` in ``count`` rounds, with a floor for false reads and misses (see :mod:`factors.rfid.model`)."""
    span = 1.0 - false_read - miss
    sigmoid = 1.0 / (1.0 + np.exp(-np.maximum(logit, NEGLIGIBLE_LOGIT)))
    q = np.clip(false_read + span * sigmoid, 1e-12, 1.0 - 1e-12)
    by_logit = span * sigmoid * (1.0 - sigmoid)
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

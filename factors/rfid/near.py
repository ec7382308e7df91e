"""What tags near a pose tell of it: those in reach are looked up and their likelihood is computed in one compiled call."""

import math
from typing import NamedTuple

import numpy as np

from factors.compiled import compiled
from factors.rfid import adjustment, kernels
from factors.rfid.counts import listing, union
from factors.rfid.index import Corner, TagIndex, within
from factors.rfid.kernels import FAST, detection, of_tag, placed, terms
from factors.rfid.model import NEGLIGIBLE_LOGIT, Packed
from factors.se2 import Array, Integers

SPARE = 0.5  # m: tags are looked up in a box on a grid of this size, which neighbouring poses share

Seen = tuple[Array, Integers, Integers, Integers, Array, Array, Integers, float]
Told = tuple[float, Array, Array, float, float]


class MapTags(NamedTuple):
    """The tags of a map: ``points`` (T, 3) [m] and ``normals`` (T, 2), with their index."""

    cells: TagIndex
    points: Array
    normals: Array


class NearTags(NamedTuple):
    """C tags that matter to some poses: places in the map, ascending, and what is known and seen of them."""

    tags: Integers
    points: Array
    normals: Array
    hits: Integers
    odds: Array
    elsewhere: Array


@compiled
def reach_of(packed: Packed, offsets: Array, antennas: Integers) -> float:
    """How far [m] the antennas reach at most from the pose that looks (K,) are relative to."""
    way = farthest = 0.0
    for k in range(len(antennas)):
        way = max(way, math.hypot(offsets[k, 0], offsets[k, 1]))
    for a in range(len(packed.which)):
        lever = math.hypot(packed.antennas[a, 0], packed.antennas[a, 1])
        farthest = max(farthest, packed.reach[packed.which[a]] + lever)
    return way + farthest


@compiled
def _box(poses: Array, reach: float) -> tuple[Corner, Corner]:
    """The corners of the box that holds what is within ``reach`` [m] of poses (N, 3), on a grid, so that the same tags count
    whatever was looked at before: to the last bit, sums depend on them."""
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for n in range(len(poses)):
        low_x, high_x = min(low_x, poses[n, 0]), max(high_x, poses[n, 0])
        low_y, high_y = min(low_y, poses[n, 1]), max(high_y, poses[n, 1])
    low = SPARE * math.floor((low_x - reach) / SPARE), SPARE * math.floor((low_y - reach) / SPARE)
    return low, (SPARE * math.ceil((high_x + reach) / SPARE), SPARE * math.ceil((high_y + reach) / SPARE))


@compiled
def near_tags(of_map: MapTags, seen: Seen, poses: Array, reach: float) -> NearTags:
    """The tags within ``reach`` [m] of poses (N, 3), or in the same cells, and those that are listed in what was ``seen``
    (:attr:`factors.rfid.counts.TagReadCounts.seen`)."""
    _, _, _, hits, odds, elsewhere, listed, others = seen
    low, high = _box(poses, reach)
    tags = union(within(of_map.cells, low, high), listed)
    hits, odds, elsewhere = listing(listed, hits, odds, elsewhere, others, tags)
    points, normals = np.empty((len(tags), 3)), np.empty((len(tags), 2))
    for u in range(len(tags)):
        for i in range(3):
            points[u, i] = of_map.points[tags[u], i]
        for i in range(2):
            normals[u, i] = of_map.normals[tags[u], i]
    return NearTags(tags, points, normals, hits, odds, elsewhere)


@compiled
def scores(
    packed: Packed, of_map: MapTags, seen: Seen, tempering: float, poses: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """The fields of a :class:`~factors.rfid.detection.Score` of poses (N, 3)."""
    offsets, antennas, rounds = seen[:3]
    n = len(poses)
    nll, gradient, information = np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3))
    expected, variance = np.empty(n), np.empty(n)
    near = near_tags(of_map, seen, poses, reach_of(packed, offsets, antennas))
    kernels.score(
        packed,
        poses,
        near.points,
        near.normals,
        offsets,
        antennas,
        rounds,
        near.hits,
        near.odds,
        near.elsewhere,
        tempering,
        nll,
        gradient,
        information,
        expected,
        variance,
    )
    none, mean, spread = _unlisted(packed, of_map, near, rounds, tempering)
    for i in range(n):
        nll[i], expected[i], variance[i] = nll[i] + none, expected[i] + mean, variance[i] + spread
    return nll, gradient, information, expected, variance


@compiled
def score(
    packed: Packed, of_map: MapTags, seen: Seen, tempering: float, pose: Array, parameters: Array, estimated: Integers
) -> Told:
    """Of one pose (3,) and a model as it was packed first, with ``parameters`` (2 M,): negative log-likelihood; its gradient
    (3 + P,) and information (3 + P, 3 + P), by the pose and those parameters that are ``estimated`` (P,); mean and variance."""
    offsets, antennas, rounds = seen[:3]
    own, size = adjustment.adjusted(packed, parameters), 3 + len(estimated)
    at = pose.copy().reshape(1, 3)
    if len(estimated) == 0:
        told = scores(own, of_map, seen, tempering, at)
        return told[0][0], told[1][0], told[2][0], told[3][0], told[4][0]
    whole, curve = np.empty(3 + len(parameters)), np.empty((3 + len(parameters), 3 + len(parameters)))
    near = near_tags(of_map, seen, at, reach_of(own, offsets, antennas))
    nll, expected, variance = adjustment.score(
        own,
        pose,
        near.points,
        near.normals,
        offsets,
        antennas,
        rounds,
        near.hits,
        near.odds,
        near.elsewhere,
        tempering,
        whole,
        curve,
    )
    gradient, information, kept = np.empty(size), np.empty((size, size)), np.empty(size, np.int64)
    for i in range(size):
        kept[i] = i if i < 3 else 3 + estimated[i - 3]
    for i in range(size):
        gradient[i] = whole[kept[i]]
        for j in range(size):
            information[i, j] = curve[kept[i], kept[j]]
    none, mean, spread = _unlisted(own, of_map, near, rounds, tempering)
    return nll + none, gradient, information, expected + mean, variance + spread


@compiled(error_model="numpy", fastmath=FAST)
def predicted(
    packed: Packed, of_map: MapTags, seen: Seen, pose: Array, parameters: Array
) -> tuple[Integers, Integers, Array, Array]:
    """With ``parameters`` (2 M,) of a model as it was packed first, of the tags near a pose (3,) or listed: their places in the map
    (C,), and for each look the hits, the probability of a read and the distance [m] in the plane from the antenna, (K, C)."""
    offsets, antennas = seen[:2]
    own = adjustment.adjusted(packed, parameters)
    near = near_tags(of_map, seen, pose.copy().reshape(1, 3), reach_of(own, offsets, antennas))
    p, distance = np.empty(near.hits.shape), np.empty(near.hits.shape)
    for k in range(len(antennas)):
        x, y, c, s, _, _ = placed(own, antennas[k], pose, offsets[k])
        rate = own.rate[own.which[antennas[k]]]
        for u in range(len(near.tags)):
            z = of_tag(own, antennas[k], x, y, c, s, near.points[u], near.normals[u])[0]
            p[k, u] = detection(own, z, rate)[0]
            distance[k, u] = math.hypot(near.points[u, 0] - x, near.points[u, 1] - y)
    return near.tags, near.hits, p, distance


@compiled
def _unlisted(
    packed: Packed, of_map: MapTags, near: NearTags, rounds: Integers, tempering: float
) -> tuple[float, float, float]:
    """Negative log-likelihood of all other tags together, which are out of reach and not read, its mean and variance."""
    nll, _, _, mean, spread = terms(packed, NEGLIGIBLE_LOGIT, 1.0, 0, rounds.sum())
    count = tempering * (len(of_map.points) - len(near.tags))
    return count * nll, count * mean, count * spread

"""Filtering of the state of each tag of a map: as surveyed, moved or dead.

A tag is *as surveyed*, where the map has it; *moved*, at one of K places around there (:func:`displacements`); or *dead*: broken,
hidden or gone, and never read. Given the robot's poses, the states of tags are independent, so each tag has a filter of its own,
whose prediction is trivial, as states last. Of the tags as surveyed a scan tells the pose; of the others it tells their state only.
With prior odds ``exp(odds)`` of dead or moved against as surveyed, and E the negative log-likelihood of a tag's reads and misses if
it is as surveyed, relative to a silence out of range, a tag's likelihood of a pose is the mixture

 log p = log(exp(-E) + exp(odds + elsewhere)) - log(1 + exp(odds)),

where ``elsewhere`` is the log-likelihood of the same reads and misses if the tag is dead or moved: the mean over these states,
weighed by what is known before the scan, at the pose that was predicted. It is no function of the pose, which bounds what a tag
costs a pose. As E is tempered, so is the evidence on the state. The odds in a likelihood are those before its scan, so that no
scan is used twice.

How many tags have moved is learnt as well: the more of those that were read are found to have moved, the likelier it is of the next
one. The share has a beta prior with the mean that the rig tells.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.compiled import compiled
from factors.gaussian import cholesky
from factors.rfid.index import MapTags, Seen, delayed, near_tags
from factors.rfid.kernels import FAST, reach_of
from factors.rfid.model import Packed
from factors.rfid.parameters import adjusted
from factors.rfid.tables import Tables
from factors.rfid.weighing import FARTHEST_RATIO, fast_exp, mark_near, place_looks, tags_of_tables, weigh_tag
from factors.se2 import Array, Integers

KEPT = 200.0  # s of evidence that can be taken back
BELIEVED = 0.5  # probability above which a tag is believed to be dead, or moved
LIMIT = math.log(BELIEVED / (1.0 - BELIEVED))
PITCH, FARTHEST = 0.5, 1.5  # m: of the grid of displacements, and the largest of them
WORTH = 20.0  # tags that were read: what the prior of the share of moved ones is worth
DEAD = 1  # column of the weights: as surveyed, dead, and moved to each place


def displacements() -> Array:
    """The displacements (K, 2) [m] of moved tags: a grid in a disc, without its centre."""
    steps = np.arange(-FARTHEST, FARTHEST + 0.5 * PITCH, PITCH)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    distance = np.hypot(*grid.T)
    return np.asarray(grid[(distance > 0.5 * PITCH) & (distance < FARTHEST + 1e-9)])


def _log(probability: float) -> float:
    return math.log(probability) if probability > 0.0 else -math.inf


class TagStates:
    """The states of T tags. ``dead`` and ``moved``: prior probabilities, together below 1, that a tag is so; ``prior``: the
    log-odds of both."""

    def __init__(self, count: int, dead: float, moved: float) -> None:
        moves = displacements()
        # of a tag as surveyed, then of moved ones
        self.places = np.concatenate((np.zeros((1, 2)), moves))
        each = _log(moved / len(moves))
        prior = np.array((math.log(1.0 - dead - moved), _log(dead), *(each for _ in moves)))
        self._weights = np.tile(prior, (count, 1))  # logarithms, not normalised
        self._dead, self._moved, self._surveyed, self._raised = dead, moved, prior[0], 0.0
        self.prior = float(_log(dead + moved) - prior[0])
        self.odds: Array = np.full(count, self.prior)  # log-odds (T,) of dead or moved against as surveyed
        self._doubtful: Integers | None = None  # not known
        # time, tags, and what they told of each state
        self._told: deque[tuple[float, Integers, NDArray[np.float32]]] = deque()
        self._heard = -math.inf

    @property
    def heard(self) -> float:
        """Time of the last read [s], ``-inf`` if there was none."""
        return self._heard

    @property
    def doubtful(self) -> Integers:
        """The tags that are dead or moved with a probability above :data:`BELIEVED`, ascending."""
        if self._doubtful is None:
            self._doubtful = np.flatnonzero(self.odds > LIMIT)
        return self._doubtful

    @property
    def suspects(self) -> dict[int, float]:
        """The probability of each of these, which is told."""
        tags = self.doubtful
        return dict(zip(tags.tolist(), (1.0 / (1.0 + np.exp(-self.odds[tags]))).tolist(), strict=True))

    def were_read(self, tags: Integers) -> NDArray[np.bool_]:
        """Which of ``tags`` (U,) were read, which are not dead then."""
        return np.asarray(self._weights[tags, DEAD] == -np.inf)

    def was_read(self, tag: int) -> bool:
        """Whether a tag was read."""
        return bool(self.were_read(np.array((tag,)))[0])

    def hear(self, t: float, tags: Integers) -> None:
        """Tags (R,) were read at ``t``: they are not dead."""
        if len(tags):
            self._changed(*_hear(self._weights, self.odds, tags, self._raised, self._moved))
            self._heard = max(self._heard, t)

    def expect(self, tags: Integers, told: Array) -> Array:
        """The log-likelihood (U,) of what was seen of U ``tags``, of those that are dead or moved. ``told`` (U, 1 + K): the
        log-likelihoods if they are as surveyed, and at each place, relative to a silence out of range."""
        return _expected(self._weights, tags, told)

    def learn(self, t: float, tags: Integers, told: Array) -> None:
        """Take what was ``told`` (U, 1 + K) of U ``tags`` at ``t``, see :meth:`expect`."""
        if len(tags):
            self._told.append((t, tags, told.astype(np.float32)))
            self._changed(*_learn(self._weights, self.odds, tags, self._told[-1][2], 1.0, self._raised, self._moved))
        while self._told and self._told[0][0] < t - KEPT:
            self._told.popleft()

    def forget(self, since: float) -> None:
        """Take back what was learnt since ``since``, at most :data:`KEPT` seconds: the robot was elsewhere, or it will be processed
        again. That a tag was read is kept."""
        kept: deque[tuple[float, Integers, NDArray[np.float32]]] = deque()
        for row in self._told:
            if row[0] < since:
                kept.append(row)
            else:
                self._changed(*_learn(self._weights, self.odds, row[1], row[2], -1.0, self._raised, self._moved))
        self._told = kept

    def _changed(self, doubtful: bool, raised: float) -> None:
        """Update what depends on the weights; ``doubtful``: whether another set of tags is doubtful; ``raised``: the logarithm by
        which the prior of moved tags rises."""
        if doubtful:
            self._doubtful = None
        if raised != self._raised:
            self._weights[:, DEAD + 1 :] += raised - self._raised
            self.odds, self._raised, self._doubtful = _all_odds(self._weights), raised, None
            self.prior = float(np.logaddexp(_log(self._dead), _log(self._moved) + raised) - self._surveyed)


@compiled
def sigma_poses(pose: Array, covariance: Array, width: float) -> Array:
    """The poses (6, 3) that lie ``width`` times a column of the root of ``covariance`` (3, 3) before and behind ``pose`` (3,)."""
    out = np.empty((6, 3))
    root, exists = cholesky(covariance)
    if not exists:  # by rounding: correlations are ignored
        root = np.diag(np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(6):
        sign = width if i < 3 else -width
        x, y, turned = se2.exp_scalars(sign * root[0, i % 3], sign * root[1, i % 3], sign * root[2, i % 3])
        out[i, 0], out[i, 1] = pose[0] + c * x - s * y, pose[1] + s * x + c * y
        out[i, 2] = se2.wrap_scalar(pose[2] + turned)
    return out


@compiled(error_model="numpy", fastmath=FAST)
def displaced(
    packed: Packed,
    tables: Tables,
    of_map: MapTags,
    seen: Seen,
    poses: Array,
    margin: float,
    odds: Array,
    shifts: Array,
    tempering: float,
    parameters: Array,
) -> tuple[Integers, Array, NDArray[np.bool_]]:
    """See :meth:`factors.rfid.detection.RfidLikelihood.displaced`."""
    placed = adjusted(packed, parameters)
    looks = delayed(seen[0], seen[8], placed.delay), seen[1], seen[2]
    reach = margin + reach_of(placed, looks[0])
    near = near_tags(of_map, seen, poses, reach)
    tags, heard = tags_of_tables(tables, near), np.zeros(len(near.tags), np.bool_)
    for u in range(len(heard)):
        for k in range(len(looks[1])):
            heard[u] |= near.hits[k, u] > 0
    kept = np.empty(len(heard), np.bool_)
    mark_near(poses, tags, reach, kept)
    for u in range(len(heard)):
        kept[u] = (kept[u] or heard[u]) and odds[near.tags[u]] > -np.inf
    found = np.flatnonzero(kept)
    out = np.empty((len(found), len(shifts)))
    each = len(poses)
    size = len(shifts) * each
    # what is seen of a tag that was moved is what is seen of the map's from poses that were moved the other way
    moved = np.empty((size, 3))
    for i in range(size):
        shift, pose = shifts[i // each], poses[i % each]
        moved[i, 0], moved[i, 1], moved[i, 2] = pose[0] - shift[0], pose[1] - shift[1], pose[2]
    at, models = np.empty((len(looks[1]), 4, size)), np.empty((len(packed.kinds), 2, size))
    own, product, room = np.empty(size), np.empty(size), np.empty(size)
    place_looks(placed, moved, looks, parameters.reshape(1, -1), parameters, at, models)
    matters = np.ones(len(looks[1]), np.bool_)
    for u in range(len(found)):
        weigh_tag(packed, tables, at, models, size, looks, tags, found[u], matters, own, product, room)
        for i in range(len(shifts)):
            most = own[i * each]
            for n in range(i * each + 1, (i + 1) * each):
                most = max(most, own[n])
            out[u, i] = tempering * most
            for n in range(i * each, (i + 1) * each):
                own[n] = max(tempering * (own[n] - most), -FARTHEST_RATIO)
        for n in range(size):
            own[n] = fast_exp(own[n])
        for i in range(len(shifts)):
            mean = 0.0
            for n in range(i * each, (i + 1) * each):
                mean += own[n] / each
            out[u, i] += math.log(mean)
    return near.tags[found], out, heard[found]


@compiled
def _log_sum(weights: Array, told: Array) -> float:
    """The logarithm of the sum of all that ``weights`` and what is ``told``, which is added to all but the first, stand for."""
    most = weights[0]
    for k in range(1, len(weights)):
        most = max(most, weights[k] + told[k])
    if most == -np.inf:
        return -math.inf
    total = math.exp(weights[0] - most)
    for k in range(1, len(weights)):
        total += math.exp(weights[k] + told[k] - most)
    return float(most + math.log(total))


@compiled
def _expected(weights: Array, tags: Integers, told: Array) -> Array:
    out, nothing = np.empty(len(tags)), np.zeros(told.shape[1])
    for u in range(len(tags)):
        before = _log_sum(weights[tags[u], DEAD:], nothing)
        out[u] = -np.inf if before == -np.inf else _log_sum(weights[tags[u], DEAD:], told[u]) - before
    return out


@compiled
def _hear(weights: Array, odds: Array, tags: Integers, raised: float, moved: float) -> tuple[bool, float]:
    """Take ``tags`` to be not dead. Returns whether another set of tags is doubtful, and the rise of the prior of moved tags."""
    changed = False
    for t in tags:
        if weights[t, DEAD] > -np.inf:
            weights[t, DEAD] = -np.inf
            before, odds[t] = odds[t], _odds(weights[t])
            changed |= (before > LIMIT) != (odds[t] > LIMIT)
    return changed, _raised(weights, odds, raised, moved)


@compiled
def _learn(
    weights: Array, odds: Array, tags: Integers, told: NDArray[np.float32], sign: float, raised: float, moved: float
) -> tuple[bool, float]:
    """Add log-likelihoods. Returns whether another set of tags is doubtful, and the rise of the prior of moved tags."""
    changed = False
    for u in range(len(tags)):
        of_tag, before = weights[tags[u]], odds[tags[u]]
        of_tag[0] += sign * told[u, 0]
        for k in range(1, told.shape[1]):
            of_tag[DEAD + k] += sign * told[u, k]
        odds[tags[u]] = _odds(of_tag)
        changed |= (before > LIMIT) != (odds[tags[u]] > LIMIT)
    return changed, _raised(weights, odds, raised, moved)


@compiled
def _raised(weights: Array, odds: Array, raised: float, moved: float) -> float:
    """The logarithm by which the prior of moved tags rises, by the share of moved ones among the tags that were read.

    More tags are believed to have moved with a higher prior. The result is the lowest prior that explains itself, which depends on
    the evidence only, not on its order. ``odds`` (T,) are those with a prior that has risen by ``raised``.
    """
    if moved == 0.0:
        return 0.0
    out, read = 0.0, 0
    for t in range(len(odds)):
        read += weights[t, DEAD] == -np.inf
    while True:
        found = 0
        for t in range(len(odds)):
            # a tag that was read is not dead, so its odds rise as the prior does
            found += weights[t, DEAD] == -np.inf and odds[t] - raised + out > LIMIT
        share = (WORTH * moved + found) / (WORTH + read)
        higher = math.log(max(share / moved, 1.0))
        if higher <= out:
            return out
        out = higher


@compiled
def _all_odds(weights: Array) -> Array:
    return np.array([_odds(of_tag) for of_tag in weights])


@compiled
def _odds(weights: Array) -> float:
    return float(_log_sum(weights[DEAD:], np.zeros(len(weights) - DEAD)) - weights[0])

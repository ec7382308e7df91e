"""Filtering of the state of each tag of a map: as surveyed, weak, moved or dead.

A tag is *as surveyed*: where the map has it, with the strength of its antenna's model; *weak*: there, but read much less, as on
metal (:data:`WEAKNESSES`); *moved*: at one of the places around there (:func:`displacements`); or *dead*: broken, hidden or gone,
and never read. Given the robot's poses, the states of tags are independent. So each tag has a filter of its own, whose prediction
is trivial, because states last. A scan informs the pose by the tags as surveyed only.

With prior odds ``exp(odds)`` of not as surveyed against as surveyed, and E the negative log-likelihood of a tag's reads and misses
if it is as surveyed, relative to a silence out of range, a tag's likelihood of a pose is the mixture

 log p = log(exp(-E) + exp(odds + elsewhere)) - log(1 + exp(odds)),

where ``elsewhere`` is the log-likelihood of the same reads and misses if the tag is not as surveyed: the mean over these states,
weighted by their probabilities before the scan, at the predicted pose. It does not depend on the pose, so that the cost
of a tag is bounded. E and the evidence on the state have the same tempering. The odds in a likelihood precede its scan, so that
no scan is used twice.

The share of moved tags is learnt as well, up to :data:`MOST_MOVED`: the more of the tags that were read have moved, the higher is
the prior of the next one. The share has a beta prior with the mean of the rig.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.compiled import compiled
from factors.gaussian import cholesky
from factors.rfid.index import Counts, MapTags, delayed, near_tags
from factors.rfid.kernels import FAST, reach_of
from factors.rfid.model import Packed
from factors.rfid.parameters import adjusted
from factors.rfid.tables import Tables
from factors.rfid.weighing import FARTHEST_RATIO, fast_exp, mark_near, place_antennas, tags_of_tables, weigh_tag
from factors.se2 import Array, Integers

KEPT = 200.0  # s of evidence that can be taken back
BELIEVED = 0.5  # probability above which a tag is believed to be dead, weak or moved
LIMIT = math.log(BELIEVED / (1.0 - BELIEVED))
PITCH, FARTHEST = 0.5, 1.5  # m: of the grid of displacements, and the largest of them
WORTH = 20.0  # tags that were read: what the prior of the share of moved ones is worth
# largest learnt share: beyond it a wrong pose or model is likelier than so many moved tags
MOST_MOVED = 0.15
# weak tags: changes of the logarithm of the range and of the logit of the read rate, as of the parameters of a detection model
# (:mod:`factors.rfid.parameters`), and their shares
WEAKNESSES = np.array(((0.0, -2.4, 0.5), (0.0, -3.7, 0.1), (-0.5, 0.0, 0.2), (-0.5, -1.0, 0.2)))
# columns of the weights: as surveyed, then dead, weak, and moved to each place
DEAD, WEAK, MOVED = 1, 2, 2 + len(WEAKNESSES)
COLUMNS = {"dead": slice(DEAD, WEAK), "weak": slice(WEAK, MOVED), "moved": slice(MOVED, None)}


def displacements() -> Array:
    """The displacements (K, 2) [m] of moved tags: a grid in a disc, without its centre."""
    steps = np.arange(-FARTHEST, FARTHEST + 0.5 * PITCH, PITCH)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    distance = np.hypot(*grid.T)
    return np.asarray(grid[(distance > 0.5 * PITCH) & (distance < FARTHEST + 1e-9)])


def hypotheses() -> Array:
    """The states (S, 4) of a tag that may be read, displacement [m] and change of strength: as surveyed, then weak, then moved."""
    weak, moves = WEAKNESSES[:, :2], displacements()
    still, usual = np.zeros_like(weak), np.zeros_like(moves)
    return np.concatenate((np.zeros((1, 4)), np.hstack((still, weak)), np.hstack((moves, usual))))


def _log(probability: float) -> float:
    return math.log(probability) if probability > 0.0 else -math.inf


class TagStates:
    """The states of T tags. ``dead``, ``weak`` and ``moved``: prior probabilities, together below 1, that a tag is so; ``prior``:
    the log-odds of all three against as surveyed."""

    def __init__(self, count: int, dead: float, weak: float, moved: float) -> None:
        self.hypotheses = hypotheses()
        places = len(self.hypotheses) - 1 - len(WEAKNESSES)
        usual = 1.0 - dead - weak - moved
        shares = (usual, dead, *(weak * WEAKNESSES[:, 2]), *np.full(places, moved / places))
        prior = np.array([_log(share) for share in shares])
        self._weights = np.tile(prior, (count, 1))  # logarithms, not normalised
        self._prior, self._moved, self._raised = prior, moved, 0.0
        self.prior = _odds(prior)
        self.odds: Array = np.full(count, self.prior)  # log-odds (T,) of not as surveyed against as surveyed
        self._doubtful: Integers | None = None  # not known
        # time, tags, and the log-likelihoods of their states
        self._evidence: deque[tuple[float, Integers, NDArray[np.float32]]] = deque()
        self.last_read = -math.inf  # time [s]

    @property
    def doubtful(self) -> Integers:
        """The tags that are dead, weak or moved with a probability above :data:`BELIEVED`, ascending."""
        if self._doubtful is None:
            self._doubtful = np.flatnonzero(self.odds > LIMIT)
        return self._doubtful

    @property
    def suspects(self) -> dict[str, dict[int, float]]:
        """The tags that are dead, weak or moved with a probability above :data:`BELIEVED`, by state, with that probability."""
        doubtful, suspects = self.doubtful, dict[str, dict[int, float]]()
        weights = self._weights[doubtful]
        shares = np.exp(weights - weights.max(axis=1, keepdims=True))
        shares /= shares.sum(axis=1, keepdims=True)
        for state, columns in COLUMNS.items():
            probability = shares[:, columns].sum(axis=1)
            rows = np.flatnonzero(probability > BELIEVED)
            suspects[state] = dict(zip(doubtful[rows].tolist(), probability[rows].tolist(), strict=True))
        return suspects

    def were_read(self, tags: Integers) -> NDArray[np.bool_]:
        """Which of ``tags`` (U,) were read, and are not dead therefore."""
        return np.asarray(self._weights[tags, DEAD] == -np.inf)

    def hear(self, t: float, tags: Integers) -> None:
        """Tags (R,) were read at ``t``: they are not dead."""
        if len(tags):
            if _hear(self._weights, self.odds, tags):
                self._doubtful = None
            self._raise_prior()
            self.last_read = max(self.last_read, t)

    def expect(self, tags: Integers, evidence: Array) -> Array:
        """The log-likelihood (U,) of a scan's reads and misses of U ``tags`` that are not as surveyed. ``evidence`` (U, S): the
        log-likelihoods for each of the ``hypotheses``, relative to a silence out of range."""
        return _expected(self._weights, tags, evidence)

    def learn(self, t: float, tags: Integers, evidence: Array) -> None:
        """Add the log-likelihoods ``evidence`` (U, S) of U ``tags`` at ``t``, see :meth:`expect`."""
        if len(tags):
            self._evidence.append((t, tags, evidence.astype(np.float32)))
            self._add(tags, self._evidence[-1][2], 1.0)
        while self._evidence and self._evidence[0][0] < t - KEPT:
            self._evidence.popleft()

    def forget(self, since: float) -> None:
        """Take back what was learnt since ``since``, at most :data:`KEPT` seconds: the robot was elsewhere, or it will be processed
        again. That a tag was read is kept."""
        kept: deque[tuple[float, Integers, NDArray[np.float32]]] = deque()
        for row in self._evidence:
            if row[0] < since:
                kept.append(row)
            else:
                self._add(row[1], row[2], -1.0)
        self._evidence = kept

    def _add(self, tags: Integers, evidence: NDArray[np.float32], sign: float) -> None:
        if _learn(self._weights, self.odds, tags, evidence, sign):
            self._doubtful = None
        self._raise_prior()

    def _raise_prior(self) -> None:
        """Raise the prior of moved tags to their share, at most :data:`MOST_MOVED`, among the tags that were read."""
        raised = _raised(self._weights, self.odds, self._moved, self._raised)
        if raised != self._raised:
            self._weights[:, MOVED:] += raised - self._raised
            self.odds, self._raised, self._doubtful = _all_odds(self._weights), raised, None
            prior = self._prior.copy()
            prior[MOVED:] += raised
            self.prior = _odds(prior)


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
    counts: Counts,
    poses: Array,
    margin: float,
    odds: Array,
    hypotheses: Array,
    tempering: float,
    parameters: Array,
) -> tuple[Integers, Array, NDArray[np.bool_]]:
    """See :meth:`factors.rfid.detection.RfidLikelihood.displaced`."""
    placed = adjusted(packed, parameters)
    measured = delayed(counts[0], counts[8], placed.delay), counts[1], counts[2]
    reach = margin + reach_of(placed, measured[0])
    near = near_tags(of_map, counts, poses, reach)
    tags, read = tags_of_tables(tables, near), np.zeros(len(near.tags), np.bool_)
    for u in range(len(read)):
        for k in range(len(measured[1])):
            read[u] |= near.hits[k, u] > 0
    kept = np.empty(len(read), np.bool_)
    mark_near(poses, tags, reach, kept)
    for u in range(len(read)):
        kept[u] = (kept[u] or read[u]) and odds[near.tags[u]] > -np.inf
    chosen = np.flatnonzero(kept)
    out = np.empty((len(chosen), len(hypotheses)))
    each = len(poses)
    size = len(hypotheses) * each
    # reads of a tag that was moved are those of the map's tag from poses that were moved the other way
    moved, changed = np.empty((size, 3)), np.empty((size, len(parameters)))
    for i in range(size):
        state, pose = hypotheses[i // each], poses[i % each]
        moved[i, 0], moved[i, 1], moved[i, 2] = pose[0] - state[0], pose[1] - state[1], pose[2]
        changed[i] = parameters
        for m in range(len(packed.kinds)):
            changed[i, 2 * m] += state[2]
            changed[i, 2 * m + 1] += state[3]
    at, models = np.empty((len(measured[1]), 4, size)), np.empty((len(packed.kinds), 2, size))
    own, product, room = np.empty(size), np.empty(size), np.empty(size)
    place_antennas(placed, moved, measured, changed, parameters, at, models)
    matters = np.ones(len(measured[1]), np.bool_)
    for u in range(len(chosen)):
        weigh_tag(packed, tables, at, models, size, measured, tags, chosen[u], matters, own, product, room)
        for i in range(len(hypotheses)):
            most = own[i * each]
            for n in range(i * each + 1, (i + 1) * each):
                most = max(most, own[n])
            out[u, i] = tempering * most
            for n in range(i * each, (i + 1) * each):
                own[n] = max(tempering * (own[n] - most), -FARTHEST_RATIO)
        for n in range(size):
            own[n] = fast_exp(own[n])
        for i in range(len(hypotheses)):
            mean = 0.0
            for n in range(i * each, (i + 1) * each):
                mean += own[n] / each
            out[u, i] += math.log(mean)
    return near.tags[chosen], out, read[chosen]


@compiled
def _log_sum(weights: Array, evidence: Array) -> float:
    """The logarithm of the sum of the exponentials of ``weights`` + ``evidence`` (N,)."""
    most = -math.inf
    for k in range(len(weights)):
        most = max(most, weights[k] + evidence[k])
    if most == -math.inf:
        return -math.inf
    total = 0.0
    for k in range(len(weights)):
        total += math.exp(weights[k] + evidence[k] - most)
    return float(most + math.log(total))


@compiled
def _odds(weights: Array) -> float:
    """The log-odds of not as surveyed against as surveyed."""
    return float(_log_sum(weights[DEAD:], np.zeros(len(weights) - DEAD)) - weights[0])


@compiled
def _expected(weights: Array, tags: Integers, evidence: Array) -> Array:
    out, added = np.empty(len(tags)), np.zeros(weights.shape[1] - DEAD)
    for u in range(len(tags)):
        unsurveyed = weights[tags[u], DEAD:]
        added[:] = 0.0
        prior = _log_sum(unsurveyed, added)
        added[1:] = evidence[u, 1:]
        out[u] = -np.inf if prior == -np.inf else _log_sum(unsurveyed, added) - prior
    return out


@compiled
def _hear(weights: Array, odds: Array, tags: Integers) -> bool:
    """Take ``tags`` to be not dead. Returns whether another set of tags is doubtful."""
    changed = False
    for t in tags:
        if weights[t, DEAD] > -np.inf:
            weights[t, DEAD] = -np.inf
            old_odds, odds[t] = odds[t], _odds(weights[t])
            changed |= (old_odds > LIMIT) != (odds[t] > LIMIT)
    return changed


@compiled
def _learn(weights: Array, odds: Array, tags: Integers, evidence: NDArray[np.float32], sign: float) -> bool:
    """Add log-likelihoods. Returns whether another set of tags is doubtful."""
    changed = False
    for u in range(len(tags)):
        of_tag, old_odds = weights[tags[u]], odds[tags[u]]
        for k in range(evidence.shape[1]):
            of_tag[k if k < DEAD else k + 1] += sign * evidence[u, k]
        odds[tags[u]] = _odds(of_tag)
        changed |= (old_odds > LIMIT) != (odds[tags[u]] > LIMIT)
    return changed


@compiled
def _all_odds(weights: Array) -> Array:
    return np.array([_odds(of_tag) for of_tag in weights])


@compiled
def _raised(weights: Array, odds: Array, moved: float, raised: float) -> float:
    """The increase of the log prior of moved tags, from the share of moved tags among those that were read.

    More tags are believed to have moved with a higher prior. The result is the lowest prior that explains itself, which depends on
    the evidence only, not on its order. ``weights`` (T, W) and ``odds`` (T,) are those with a prior that has risen by ``raised``.
    """
    if moved == 0.0:
        return 0.0
    most, read = max(MOST_MOVED, moved), 0
    unraised = np.empty(
        len(odds)
    )  # log-odds of moved, without the rise, of those tags that could be believed to have moved
    candidates = 0
    for t in range(len(odds)):
        if weights[t, DEAD] > -np.inf:
            continue
        read += 1
        if odds[t] - raised + math.log(most / moved) > LIMIT:
            moves = _log_sum(weights[t, MOVED:], np.zeros(weights.shape[1] - MOVED))
            unraised[candidates] = moves - _log_sum(weights[t, :MOVED], np.zeros(MOVED)) - raised
            candidates += 1
    out = 0.0
    while True:
        moved_tags = 0
        for i in range(candidates):
            moved_tags += unraised[i] + out > LIMIT
        share = min((WORTH * moved + moved_tags) / (WORTH + read), most)
        higher = math.log(max(share / moved, 1.0))
        if higher <= out:
            return out
        out = higher

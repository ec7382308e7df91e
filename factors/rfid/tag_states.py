"""Filters that estimate the state of each tag of a map: as surveyed, weak, moved or dead.

- *as surveyed*: the tag is where the map has it, and is read as the detection model predicts;
- *weak*: the tag is where the map has it, but is read much less, for example on metal (:data:`WEAKNESSES`);
- *moved*: the tag is at one of several displacements from its position in the map (:func:`displacements`);
- *dead*: the tag is broken, hidden or gone, and is never read.

Given the robot's poses, the states of tags are independent. So each tag has its own filter. The filter has no
prediction step, because states do not change. Only tags as surveyed inform the robot's pose.

Let ``exp(odds)`` be the prior odds that a tag is not as surveyed. Let E be the negative log-likelihood of its reads and
misses if it is as surveyed, relative to that of misses out of range. Then the tag's likelihood of a pose is the mixture

 log p = log(exp(-E) + exp(odds + elsewhere)) - log(1 + exp(odds)).

``elsewhere`` is the log-likelihood of the same reads and misses if the tag is not as surveyed. It is the mean over the
states weak, moved and dead at the predicted pose, weighted by their probabilities before the scan. It does not depend
on the pose, which bounds the influence of a tag. E and the evidence on the state have the same tempering. The odds are
those before the scan, so that no scan is used twice.

The fraction of moved tags is also estimated, up to :data:`MOST_MOVED`: the more of the read tags have moved, the higher
is the prior of the rest. The fraction has a beta prior, whose mean is a setting.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from factors import se2
from factors.compiled import compiled
from factors.gaussian import cholesky
from factors.rfid.index import Counts, MapTags, delayed, near_tags
from factors.rfid.kernels import FAST
from factors.rfid.model import Packed
from factors.rfid.mounting import reach_of
from factors.rfid.parameters import adjusted
from factors.rfid.tables import Tables
from factors.rfid.weighing import FARTHEST_RATIO, fast_exp, mark_near, place_antennas, tags_of_tables, weigh_tag
from factors.se2 import Array, Integers

KEPT = 200.0  # s; the evidence of scans is stored for this time, and can be removed from the filters until then
BELIEVED = 0.5  # a tag is reported as dead, weak or moved if the probability exceeds this value
LIMIT = math.log(BELIEVED / (1.0 - BELIEVED))
PITCH, FARTHEST = 0.5, 1.5  # m: spacing of the grid of displacements, and the largest displacement
WORTH = 20.0  # the prior of the fraction of moved tags has the weight of this number of tags that were read
# The largest estimate of the fraction of moved tags. If more tags seem to have moved, a wrong pose or model is more likely.
MOST_MOVED = 0.15
# The kinds of weak tags. Each row has the changes of the parameters a and b of a detection model (factors.rfid.parameters), which
# are the logarithm of the range and the logit of the read rate, and the fraction of weak tags of this kind.
WEAKNESSES = np.array(((0.0, -2.4, 0.5), (0.0, -3.7, 0.1), (-0.5, 0.0, 0.2), (-0.5, -1.0, 0.2)))
# Columns of the weights: as in the map, dead, each kind of weak from WEAK on, and each displacement from MOVED on.
DEAD, WEAK, MOVED = 1, 2, 2 + len(WEAKNESSES)
COLUMNS = {"dead": slice(DEAD, WEAK), "weak": slice(WEAK, MOVED), "moved": slice(MOVED, None)}


def displacements() -> Array:
    """Return the possible displacements (K, 2) [m] of moved tags: a grid in a disc, without the centre."""
    steps = np.arange(-FARTHEST, FARTHEST + 0.5 * PITCH, PITCH)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    distance = np.hypot(*grid.T)
    return np.asarray(grid[(distance > 0.5 * PITCH) & (distance < FARTHEST + 1e-9)])


def hypotheses() -> Array:
    """Return the S possible states (S, 4) of a tag that is not dead: as in the map, weak in several degrees, or moved
    by each of several displacements. A row has the displacement (2) [m], the change of the logarithm of the range, and
    the change of the logit of the read rate."""
    weak, moves = WEAKNESSES[:, :2], displacements()
    still, usual = np.zeros_like(weak), np.zeros_like(moves)
    return np.concatenate((np.zeros((1, 4)), np.hstack((still, weak)), np.hstack((moves, usual))))


def _log(probability: float) -> float:
    """Return the logarithm of a probability, ``-inf`` for zero."""
    return math.log(probability) if probability > 0.0 else -math.inf


class TagStates:
    """Bayesian filters that estimate whether each of T tags is as in the map, dead (never read), weak (read less often
    or at a shorter range) or moved. ``count``: T. ``dead``, ``weak``, ``moved``: prior probabilities, below 1 in sum.

    Attributes: ``odds`` (T,) are the log-odds that each tag is dead, weak or moved. ``prior`` is the prior value of the
    log-odds. ``hypotheses`` (S, 4) is the result of :func:`hypotheses`. ``last_read`` [s] is the time of the last read.
    """

    def __init__(self, count: int, dead: float, weak: float, moved: float) -> None:
        self.hypotheses = hypotheses()
        places = len(self.hypotheses) - 1 - len(WEAKNESSES)
        usual = 1.0 - dead - weak - moved
        shares = (usual, dead, *(weak * WEAKNESSES[:, 2]), *np.full(places, moved / places))
        prior = np.array([_log(share) for share in shares])
        self._weights = np.tile(prior, (count, 1))  # log-probabilities of the states of each tag, not normalised
        self._prior, self._moved, self._raised = prior, moved, 0.0
        self.prior = _odds(prior)
        self.odds: Array = np.full(count, self.prior)  # the log-odds (T,) that each tag is weak, moved or dead
        self._doubtful: Integers | None = None  # the cached result of `doubtful`, None if it must be computed
        # the evidence of the last seconds: time, tags, and the log-likelihoods of their states
        self._evidence: deque[tuple[float, Integers, NDArray[np.float32]]] = deque()
        self.last_read = -math.inf  # s; time of the last read of any tag

    @property
    def doubtful(self) -> Integers:
        """The indices of tags, ascending, that are weak, moved or dead with a probability above :data:`BELIEVED`."""
        if self._doubtful is None:
            self._doubtful = np.flatnonzero(self.odds > LIMIT)
        return self._doubtful

    @property
    def suspects(self) -> dict[str, dict[int, float]]:
        """The tags that are dead, weak or moved with a probability above :data:`BELIEVED`. The keys are "dead", "weak"
        and "moved". Each value is a dictionary from the index of a tag to the probability."""
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
        """Return a mask (U,) of the ``tags`` (U,) that have been read at any time, and are therefore not dead."""
        return np.asarray(self._weights[tags, DEAD] == -np.inf)

    def hear(self, t: float, tags: Integers) -> None:
        """Report that ``tags`` (R,) were read at time ``t`` [s]. They are not dead."""
        if len(tags):
            if _hear(self._weights, self.odds, tags):
                self._doubtful = None
            self._raise_prior()
            self.last_read = max(self.last_read, t)

    def expect(self, tags: Integers, evidence: Array) -> Array:
        """Return the log-likelihood (U,) of the reads and misses of ``tags`` (U,) in one scan, given that each tag is
        weak, moved or dead. This is the field ``elsewhere`` of :class:`~factors.rfid.detection.TagReadCounts`.

        ``evidence`` (U, S): the log-likelihood of each tag's reads and misses for each of S states
        (:attr:`hypotheses`), relative to the log-likelihood that a tag out of range is never read.
        """
        return _expected(self._weights, tags, evidence)

    def learn(self, t: float, tags: Integers, evidence: Array) -> None:
        """Update the filters of ``tags`` (U,) by a scan at ``t`` [s]. ``evidence`` (U, S): the log-likelihood of each
        tag's reads and misses for each of S states, as in :meth:`expect`."""
        if len(tags):
            self._evidence.append((t, tags, evidence.astype(np.float32)))
            self._add(tags, self._evidence[-1][2], 1.0)
        while self._evidence and self._evidence[0][0] < t - KEPT:
            self._evidence.popleft()

    def forget(self, since: float) -> None:
        """Undo :meth:`learn` for all scans since the time ``since`` [s], except those more than :data:`KEPT` seconds
        before the newest. Call this if the robot's pose was wrong in these scans, or to process them again."""
        kept: deque[tuple[float, Integers, NDArray[np.float32]]] = deque()
        for row in self._evidence:
            if row[0] < since:
                kept.append(row)
            else:
                self._add(row[1], row[2], -1.0)
        self._evidence = kept

    def _add(self, tags: Integers, evidence: NDArray[np.float32], sign: float) -> None:
        """Add (``sign`` 1) or remove (-1) the ``evidence`` (U, S) of a scan on ``tags`` (U,), see :meth:`expect`."""
        if _learn(self._weights, self.odds, tags, evidence, sign):
            self._doubtful = None
        self._raise_prior()

    def _raise_prior(self) -> None:
        """Raise the prior probability of moved tags to their estimated fraction, at most :data:`MOST_MOVED`."""
        raised = _raised(self._weights, self.odds, self._moved, self._raised)
        if raised != self._raised:
            self._weights[:, MOVED:] += raised - self._raised
            self.odds, self._raised, self._doubtful = _all_odds(self._weights), raised, None
            prior = self._prior.copy()
            prior[MOVED:] += raised
            self.prior = _odds(prior)


@compiled
def sigma_poses(pose: Array, covariance: Array, width: float) -> Array:
    """Return the sigma points (6, 3) of a Gaussian of poses. They are ``pose`` (3,) moved by plus and minus ``width``
    times each column of the lower Cholesky factor of its body-frame ``covariance`` (3, 3)."""
    out = np.empty((6, 3))
    root, exists = cholesky(covariance)
    if not exists:  # rounding made the covariance singular: ignore correlations
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
    """Return the results of :meth:`factors.rfid.detection.RfidLikelihood.displaced`, which describes most arguments.
    ``packed``, ``tables``: models with all parameters zero. ``tempering``: exponent of the likelihood."""
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
    # a tag displaced by d is read from a pose like the tag of the map from the pose displaced by -d
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
    """Return the logarithm of the sum of the exponentials of ``weights`` + ``evidence`` (N,)."""
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
    """Return the log-odds that a tag is weak, moved or dead. ``weights``: the log-probabilities of its states."""
    return float(_log_sum(weights[DEAD:], np.zeros(len(weights) - DEAD)) - weights[0])


@compiled
def _expected(weights: Array, tags: Integers, evidence: Array) -> Array:
    """Return the result of :meth:`TagStates.expect`. ``weights`` (T, W): log-probabilities of all tags' states."""
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
    """Exclude the state dead of ``tags``, in place. Returns True if a tag is no longer believed to be weak, moved or
    dead. ``weights`` (T, W), ``odds`` (T,): log-probabilities of the states, and log-odds, of all tags."""
    changed = False
    for t in tags:
        if weights[t, DEAD] > -np.inf:
            weights[t, DEAD] = -np.inf
            old_odds, odds[t] = odds[t], _odds(weights[t])
            changed |= (old_odds > LIMIT) != (odds[t] > LIMIT)
    return changed


@compiled
def _learn(weights: Array, odds: Array, tags: Integers, evidence: NDArray[np.float32], sign: float) -> bool:
    """Add ``sign`` times ``evidence`` (U, S) to the log-probabilities ``weights`` (T, W) of ``tags`` (U,), and update
    ``odds`` (T,). Returns True if this changes which tags are believed to be weak, moved or dead."""
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
    """Return the log-odds (T,) that each tag is weak, moved or dead. ``weights`` (T, W): logs of probabilities."""
    return np.array([_odds(of_tag) for of_tag in weights])


@compiled
def _raised(weights: Array, odds: Array, moved: float, raised: float) -> float:
    """Return the increase of the log prior of moved tags, from the fraction of moved tags among tags that were read.

    ``weights`` (T, W): log-probabilities of the states of all tags. ``odds`` (T,): log-odds that they are not as in the
    map. Both include the present increase ``raised``. ``moved``: the prior probability before any increase.

    A higher prior makes more tags count as moved, which makes the prior higher. The result is the smallest fixed point
    of this iteration. It depends on the evidence only, not on the order of its arrival.
    """
    if moved == 0.0:
        return 0.0
    most, read = max(MOST_MOVED, moved), 0
    # log-odds of the state moved, without the present increase, of all tags that any prior could make moved
    unraised = np.empty(len(odds))
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

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
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from factors.se2 import Array

KEPT = 200.0  # s of evidence that can be taken back
BELIEVED = 0.5  # probability above which a tag is believed to be dead, or moved
PITCH, FARTHEST = 0.5, 1.5  # m: of the grid of displacements, and the largest of them
DEAD, MOVED = 1, 2  # columns of the weights: as surveyed, dead, and moved to each place


def displacements() -> Array:
    """The displacements (K, 2) [m] of moved tags: a grid in a disc, without its centre."""
    steps = np.arange(-FARTHEST, FARTHEST + 0.5 * PITCH, PITCH)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    distance = np.hypot(*grid.T)
    return np.asarray(grid[(distance > 0.5 * PITCH) & (distance < FARTHEST + 1e-9)])


def _log(probability: float) -> float:
    return math.log(probability) if probability > 0.0 else -math.inf


def _log_sum(rows: Array) -> Array:
    """Logarithms (N,) of the sums of what ``rows`` (N, K) are the logarithms of."""
    most = rows.max(axis=1)
    safe = np.where(most > -np.inf, most, 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(safe + np.log(np.sum(np.exp(rows - safe[:, None]), axis=1)))


class TagStates:
    """The states of T tags. ``dead`` and ``moved``: prior probabilities, together below 1, that a tag is so; ``prior``: the
    log-odds of both."""

    def __init__(self, count: int, dead: float, moved: float) -> None:
        self.shifts = displacements()
        each = _log(moved / len(self.shifts))
        prior = np.array((math.log(1.0 - dead - moved), _log(dead), *(each for _ in self.shifts)))
        self._weights = np.tile(prior, (count, 1))  # logarithms, not normalised
        self.prior = float(_log(dead + moved) - prior[0])
        self._odds = np.full(count, self.prior)
        # time, tags, and what they told of each state
        self._told: deque[tuple[float, NDArray[np.int64], NDArray[np.float32]]] = deque()
        self._heard = -math.inf

    @property
    def odds(self) -> Array:
        """Log-odds (T,) of dead or moved against as surveyed."""
        return self._odds.copy()

    def odds_of(self, tags: NDArray[np.int64]) -> Array:
        """Those (U,) of U ``tags``."""
        return np.asarray(self._odds[tags])

    @property
    def heard(self) -> float:
        """Time of the last read [s], ``-inf`` if there was none."""
        return self._heard

    @property
    def doubtful(self) -> NDArray[np.int64]:
        """The tags that are more likely dead or moved than not."""
        return np.flatnonzero(self._odds > 0.0)

    @property
    def suspects(self) -> dict[int, float]:
        """The tags that are dead or moved with a probability above :data:`BELIEVED`, which is told."""
        tags = np.flatnonzero(self._odds > math.log(BELIEVED / (1.0 - BELIEVED)))
        return dict(zip(tags.tolist(), (1.0 / (1.0 + np.exp(-self._odds[tags]))).tolist(), strict=True))

    def was_read(self, tag: int) -> bool:
        """Whether a tag was read, which is not dead then."""
        return bool(self._weights[tag, DEAD] == -np.inf)

    def hear(self, t: float, tags: NDArray[np.int64]) -> None:
        """Tags (R,) were read at ``t``: they are not dead."""
        if len(tags):
            dying = tags[self._weights[tags, DEAD] > -np.inf]
            self._weights[dying, DEAD] = -np.inf
            self._weigh(dying)
            self._heard = max(self._heard, t)

    def expect(self, tags: NDArray[np.int64], told: Array) -> Array:
        """The log-likelihood (U,) of what was seen of U ``tags``, of those that are dead or moved. ``told`` (U, 1 + K): the
        log-likelihoods if they are as surveyed, and at each place, relative to a silence out of range."""
        weights = self._weights[tags, DEAD:]
        after = weights.copy()
        after[:, 1:] += told[:, 1:]
        with np.errstate(invalid="ignore"):
            return np.nan_to_num(_log_sum(after) - _log_sum(weights), nan=-np.inf, neginf=-np.inf)

    def learn(self, t: float, tags: NDArray[np.int64], told: Array) -> None:
        """Take what was ``told`` (U, 1 + K) of U ``tags`` at ``t``, see :meth:`expect`."""
        if len(tags):
            self._told.append((t, tags, told.astype(np.float32)))
            self._add(tags, self._told[-1][2])
        while self._told and self._told[0][0] < t - KEPT:
            self._told.popleft()

    def forget(self, since: float) -> None:
        """Take back what was learnt since ``since``, at most :data:`KEPT` seconds: the robot was elsewhere, or it will be processed
        again. That a tag was read is kept."""
        kept: deque[tuple[float, NDArray[np.int64], NDArray[np.float32]]] = deque()
        for row in self._told:
            if row[0] < since:
                kept.append(row)
            else:
                self._add(row[1], -row[2])
        self._told = kept

    def _add(self, tags: NDArray[np.int64], told: NDArray[np.float32]) -> None:
        self._weights[tags, 0] += told[:, 0]
        self._weights[tags, MOVED:] += told[:, 1:]
        self._weigh(tags)

    def _weigh(self, tags: NDArray[np.int64]) -> None:
        self._odds[tags] = _log_sum(self._weights[tags, DEAD:]) - self._weights[tags, 0]

"""Filtering of the state of each tag of a map: alive or dead.

A tag is *alive*, read as the antenna model says, or *dead*: broken, hidden or gone, and never read. Given the robot's poses, the
states of tags are independent. With prior odds ``o`` of dead against alive, and E the negative log-likelihood of a tag's reads
and misses if it is alive, relative to a tag out of range, its likelihood of a pose is the mixture

 log p = log(exp(-E) + exp(o) [nothing read]) - log(1 + exp(o)),

which is bounded: the silence of a tag that was never read costs a pose at most ``-log P(dead)``. For a tag that is read the last
term, ``log P(alive)``, is omitted, because it is the same at all poses. A silence adds E to the log-odds; a read sets them to
``-inf``, which gives the plain likelihood. As E is tempered, so is the evidence on the state. The odds in a likelihood are those
*before* its scan, so that no scan is used twice.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from factors.se2 import Array

KEPT = 200.0  # s of silences that can be undone
BELIEVED = 0.5  # probability above which a tag is believed dead


def log_odds(probability: float) -> float:
    """Log-odds of a probability below 1; ``-inf`` for 0."""
    return math.log(probability / (1.0 - probability)) if probability > 0.0 else -math.inf


class TagStates:
    """The states of T tags. ``dead``: prior probability, below 1, that a tag is dead; 0 means that all are alive."""

    def __init__(self, count: int, dead: float) -> None:
        self._odds = np.full(count, log_odds(dead))
        # time, tags, and the changes of their odds
        self._told: deque[tuple[float, NDArray[np.int64], Array]] = deque()
        self._heard = -math.inf

    @property
    def odds(self) -> Array:
        """Log-odds (T,) of dead against alive, ``-inf`` for tags that were read."""
        return self._odds.copy()

    @property
    def dead(self) -> Array:
        """Probability (T,) that each tag is dead."""
        with np.errstate(over="ignore"):
            return np.asarray(1.0 / (1.0 + np.exp(-self._odds)))

    @property
    def heard(self) -> float:
        """Time of the last read [s], ``-inf`` if there was none."""
        return self._heard

    @property
    def believed_dead(self) -> NDArray[np.int64]:
        """The tags that are dead with a probability above :data:`BELIEVED`."""
        return np.flatnonzero(self._odds > log_odds(BELIEVED))

    def hear(self, t: float, tags: NDArray[np.int64]) -> None:
        """Tags (R,) were read at ``t``: they are alive."""
        if len(tags):
            self._odds[tags] = -np.inf
            self._heard = max(self._heard, t)

    def miss(self, t: float, silence: Array) -> None:
        """Tags were not read at ``t``: ``silence`` (T,) is the negative log-likelihood of that if they are alive, 0 for tags that
        were read or out of range (:meth:`~factors.rfid.detection.RfidLikelihood.silence`)."""
        tags = np.flatnonzero(silence)
        if len(tags):
            self._odds[tags] += silence[tags]
            self._told.append((t, tags, silence[tags]))
        while self._told and self._told[0][0] < t - KEPT:
            self._told.popleft()

    def forget(self, since: float) -> None:
        """Undo the silences since ``since``, at most :data:`KEPT` seconds: the robot was elsewhere, or they will be processed
        again. Reads are kept."""
        kept: deque[tuple[float, NDArray[np.int64], Array]] = deque()
        for row in self._told:
            if row[0] < since:
                kept.append(row)
            else:
                self._odds[row[1]] -= row[2]
        self._told = kept

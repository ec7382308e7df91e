"""Whether each tag of a map is still what the map says, as a small discrete distribution that is filtered online.

A tag is *alive*, read as the antenna model says, or *dead*: broken, hidden or gone, and then it is never read. Nothing but its own
rounds tells which, so the states of tags are independent given where the robot is. With the prior odds ``o`` of dead against alive,
and E the negative log-likelihood of what was read and not read of the tag if it is alive, less what it is out of reach, the tag's
part of the likelihood of a pose is the mixture

    log p = log(exp(-E) + exp(o) [nothing read]) - log(1 + exp(o)),

which is bounded where an alive tag's is not: the silence of a tag that was never read costs a pose at most ``-log P(dead)``. Of a
tag that is read the last term, ``log P(alive)``, is left out: it is the same at all poses, and that a tag lives which was taken for
dead is no reason to doubt the place.
What a silence adds to the odds is E itself; one read leaves nothing of them (``-inf``), and for a tag that is known to live
the mixture is the plain likelihood. As E is tempered, so is what a silence tells of the state.

The odds that enter a likelihood are those *before* the scan that it is of, so that no scan counts twice.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from factors.se2 import Array

KEPT = 200.0  # s of silences that can be taken back
BELIEVED = 0.5  # probability above which a tag is believed dead


def log_odds(probability: float) -> float:
    """Logarithm of the odds of a probability below 1, ``-inf`` of 0."""
    return math.log(probability / (1.0 - probability)) if probability > 0.0 else -math.inf


class TagStates:
    """The states of T tags. ``dead``: probability, below 1, that a tag of which nothing was heard yet is dead; with 0 all live."""

    def __init__(self, count: int, dead: float) -> None:
        self._odds = np.full(count, log_odds(dead))
        # time, tags, and what was added to their odds
        self._told: deque[tuple[float, NDArray[np.int64], Array]] = deque()
        self._heard = -math.inf

    @property
    def odds(self) -> Array:
        """Log-odds (T,) of dead against alive, ``-inf`` of tags that were read."""
        return self._odds.copy()

    @property
    def dead(self) -> Array:
        """Probability (T,) that each tag is dead."""
        with np.errstate(over="ignore"):
            return np.asarray(1.0 / (1.0 + np.exp(-self._odds)))

    @property
    def heard(self) -> float:
        """When a tag was last read [s], ``-inf`` if none was."""
        return self._heard

    @property
    def believed_dead(self) -> NDArray[np.int64]:
        """Which tags are dead with more than :data:`BELIEVED`."""
        return np.flatnonzero(self._odds > log_odds(BELIEVED))

    def hear(self, t: float, tags: NDArray[np.int64]) -> None:
        """Tags (R,) were read at ``t``, from wherever: they live."""
        if len(tags):
            self._odds[tags] = -np.inf
            self._heard = max(self._heard, t)

    def miss(self, t: float, silence: Array) -> None:
        """Tags were not read at ``t``: ``silence`` (T,) is the negative log-likelihood of that if they are alive, 0 where a tag was
        read or out of reach (:meth:`~factors.rfid.detection.RfidLikelihood.silence`)."""
        tags = np.flatnonzero(silence)
        if len(tags):
            self._odds[tags] += silence[tags]
            self._told.append((t, tags, silence[tags]))
        while self._told and self._told[0][0] < t - KEPT:
            self._told.popleft()

    def forget(self, since: float) -> None:
        """Take back the silences from then on, at most :data:`KEPT` seconds of them: the robot was elsewhere, or they come again.
        What was read stays read."""
        kept: deque[tuple[float, NDArray[np.int64], Array]] = deque()
        for row in self._told:
            if row[0] < since:
                kept.append(row)
            else:
                self._odds[row[1]] -= row[2]
        self._told = kept

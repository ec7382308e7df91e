"""What stands in place of a solver that was lost and could not be built anew, until the next try."""

from __future__ import annotations

from collections.abc import Callable
from typing import Never

import gtsam

from factorgraph_loc.fusion.graph.summary import MarginalSummary
from factors.se2 import Array

FIRST_WAIT = 1.0  # s until the next try, twice as long each time


class Stalled:
    """No solver (:class:`~factorgraph_loc.fusion.solvers.Solver`): what was ``known`` of each variable when the last one was
    lost, and the ``left`` summary of that. Until the time ``until`` the newest pose goes on as a filter's would; ``before``: the
    last time that it did."""

    def __init__(
        self, t: float, known: Callable[[int], Array], left: MarginalSummary | None, before: Stalled | None = None
    ) -> None:
        self.wait: float = FIRST_WAIT if before is None else 2.0 * before.wait
        self.until = t + self.wait
        self._known = known
        self._left = left

    def _fail(self, *_: object, **__: object) -> Never:
        raise RuntimeError("there is no solver: the last try failed")

    update = begin = covariance = linear = _fail

    def value(self, key: int) -> Array:
        return self._known(key)

    def estimates(self) -> gtsam.Values:
        return gtsam.Values()

    @property
    def oldest(self) -> int:
        return 0 if self._left is None else self._left.oldest

    def summary(self, *, failed: bool) -> MarginalSummary | None:
        return self._left

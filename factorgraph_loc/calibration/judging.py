"""Whether an estimator is better with a parameter, by its errors and its consistency together.

The mean negative logarithmic score (Gneiting, Raftery, "Strictly proper scoring rules, prediction, and estimation", 2007) of
Gaussian estimates with mean squared errors S and mean NEES A, of d degrees of freedom, is log sqrt(det S) and, as their covariances
are wrong by the factor A / d, (A - d - d log(A / d)) / 2 besides: the divergence of Kullback and Leibler of what is stated from the
errors, 0 where the estimator is consistent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factors.se2 import Array

KINDS = ("causal", "final")
WORSE = 1.02  # times the error without a parameter, beyond which it is refused whatever it does for the consistency
LEAST = 0.005  # nats a pose that a parameter has to gain
SMALLEST = 1e-8  # mean squared error [m^2, rad^2]


@dataclass(frozen=True)
class Outcome:
    """What an estimator did on S stretches. ``squared`` (S, 2, 3): of its causal and its final poses the mean squared position
    error [m^2] and heading error [rad^2] and the mean NEES, NaN where there is none. ``scored``: (S, 2) poses. ``dof``: of the
    NEES."""

    squared: Array
    scored: Array
    dof: int

    @staticmethod
    def of(scores: Sequence[Mapping[str, Any] | None], dof: int) -> Outcome:
        """From scores of :func:`factorgraph_loc.evaluation.metrics.score`, None where the run failed."""
        squared, scored = np.full((len(scores), 2, 3), np.nan), np.zeros((len(scores), 2))
        for row, found in enumerate(scores):
            for k, kind in enumerate(KINDS):
                position, heading, nees = (
                    (found or {}).get(f"{kind}.{name}") for name in ("position_rmse", "heading_rmse", "anees")
                )
                if found is None or position is None:
                    continue
                scored[row, k] = found[f"{kind}.scored"] or 0
                squared[row, k] = (
                    position**2,
                    np.nan if heading is None else heading**2,
                    np.nan if nees is None else nees,
                )
        return Outcome(squared, scored, dof)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Stretches (S,) on which nothing was scored."""
        return np.asarray(~np.isfinite(self.squared[:, :, 0]).all(axis=1))

    def figures(self, rows: NDArray[np.bool_]) -> Array:
        """Means (2, 3) over the poses of some stretches: causal and final; position RMSE [m], heading RMSE [rad], NEES."""
        values, weights = self.squared[rows], np.broadcast_to(self.scored[rows][..., None], self.squared[rows].shape)
        there = np.isfinite(values)
        with np.errstate(invalid="ignore", divide="ignore"):
            means = np.sum(np.where(there, weights * values, 0.0), axis=0) / np.sum(weights * there, axis=0)
        return np.column_stack((np.sqrt(means[:, :2]), means[:, 2]))

    def loss(self, rows: NDArray[np.bool_]) -> float:
        """The score of some stretches, the mean of causal and final poses [nats a pose]: the lower, the better."""
        position, heading, nees = self.figures(rows).T
        error = np.log(np.maximum(position**2, SMALLEST))
        if self.dof == 3:
            error = error + 0.5 * np.log(np.maximum(heading**2, SMALLEST))
        excess = np.maximum(nees, 1e-6) / self.dof
        divergence = 0.5 * self.dof * (excess - 1.0 - np.log(excess))
        return float(np.mean(error + np.where(np.isfinite(divergence), divergence, 0.0)))


@dataclass(frozen=True)
class Judgement:
    """A parameter, or some that belong together, and what an estimator does with and without what was learnt of it.

    ``names``: of the parameters; ``gain`` in score [nats a pose] with its standard ``error``; ``new`` and ``old`` (2, 3): see
    :meth:`Outcome.figures`, on stretches that had no part in what was learnt.
    """

    names: tuple[str, ...]
    accepted: bool
    gain: float
    error: float
    new: Array
    old: Array

    @property
    def why(self) -> str:
        """In a few words."""
        if self.accepted:
            return "accepted: the estimator is better with it where it was not learnt"
        if _growth(self.new, self.old) > WORSE:
            return "refused: the estimator's error is larger with it where it was not learnt"
        return "refused: the estimator is no better with it where it was not learnt"


def judged(names: tuple[str, ...], new: Outcome, old: Outcome) -> Judgement:
    """Whether ``new`` is better than ``old``: the score gains more than chance would, by the jackknife over the stretches, and the
    error does not grow by more than a fiftieth. One who fails on more stretches than the other is worse."""
    rows = ~(new.lost | old.lost)
    figures = new.figures(rows), old.figures(rows)
    if new.lost.sum() != old.lost.sum():
        better = bool(new.lost.sum() < old.lost.sum())
        return Judgement(names, better, np.inf if better else -np.inf, np.nan, *figures)
    count = int(rows.sum())
    if count < 2:
        return Judgement(names, False, 0.0, np.nan, *figures)
    gain = old.loss(rows) - new.loss(rows)
    without = []
    for row in np.flatnonzero(rows):
        rest = rows.copy()
        rest[row] = False
        without.append(old.loss(rest) - new.loss(rest))
    error = float(np.sqrt((count - 1) / count * np.sum((np.array(without) - np.mean(without)) ** 2)))
    return Judgement(names, gain > max(error, LEAST) and _growth(*figures) <= WORSE, gain, error, *figures)


def _growth(new: Array, old: Array) -> float:
    """By what factor the error grows: that in position, or the geometric mean over position's two directions and the heading,
    causal or final, whichever grows most."""
    position, heading = (new / old)[:, :2].T
    together = np.cbrt(position**2 * np.where(np.isfinite(heading), heading, position))
    return float(np.max((position, together)))

"""Comparison of an estimator with and without a parameter, by accuracy and consistency together.

The score is the mean negative log score (Gneiting, Raftery, "Strictly proper scoring rules, prediction, and estimation", 2007)
of Gaussian estimates with mean squared errors S and mean NEES A of d degrees of freedom: log sqrt(det S), plus (A - d - d log(A
/ d)) / 2 for covariances that are wrong by the factor A / d. The latter is the Kullback-Leibler divergence of the stated
distribution from the errors, 0 for a consistent estimator.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.io.results import KINDS
from factors.se2 import Array

WORSE = 1.02  # relative increase of the error beyond which a parameter is refused, whatever the consistency
LEAST = 0.005  # nats per pose that a parameter has to gain
SMALLEST = 1e-8  # mean squared error [m^2, rad^2]


@dataclass(frozen=True)
class StretchErrors:
    """Results of an estimator on S stretches.

    ``squared`` (S, 2, 3): mean squared position error [m^2], mean squared heading error [rad^2] and mean NEES of the causal and
    final poses, NaN where missing. ``scored`` (S, 2): number of poses. ``dof``: degrees of freedom of the NEES.
    """

    squared: Array
    scored: Array
    dof: int

    @staticmethod
    def of(scores: Sequence[Mapping[str, Any] | None], dof: int) -> StretchErrors:
        """Build from scores of :func:`factorgraph_loc.evaluation.metrics.score`, None where the run failed."""
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
        return StretchErrors(squared, scored, dof)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """The stretches (S,) without any scored pose."""
        return np.asarray(~np.isfinite(self.squared[:, :, 0]).all(axis=1))

    def figures(self, rows: NDArray[np.bool_]) -> Array:
        """Position RMSE [m], heading RMSE [rad] and NEES (2, 3) over the poses of the stretches ``rows``, causal and final."""
        values, weights = self.squared[rows], np.broadcast_to(self.scored[rows][..., None], self.squared[rows].shape)
        there = np.isfinite(values)
        with np.errstate(invalid="ignore", divide="ignore"):
            means = np.sum(np.where(there, weights * values, 0.0), axis=0) / np.sum(weights * there, axis=0)
        return np.column_stack((np.sqrt(means[:, :2]), means[:, 2]))

    def loss(self, rows: NDArray[np.bool_]) -> float:
        """The score of the stretches ``rows``, mean of causal and final poses [nats per pose]; lower is better."""
        position, heading, nees = self.figures(rows).T
        error = np.log(np.maximum(position**2, SMALLEST))
        if self.dof == 3:
            error = error + 0.5 * np.log(np.maximum(heading**2, SMALLEST))
        excess = np.maximum(nees, 1e-6) / self.dof
        divergence = 0.5 * self.dof * (excess - 1.0 - np.log(excess))
        return float(np.mean(error + np.where(np.isfinite(divergence), divergence, 0.0)))


@dataclass(frozen=True)
class Judgement:
    """Comparison of an estimator with and without a learnt parameter, or several that belong together.

    ``names``: the parameters; ``gain`` in score [nats per pose] with its standard ``error``; ``new`` and ``old`` (2, 3): see
    :meth:`Outcome.figures`, on held-out stretches.
    """

    names: tuple[str, ...]
    accepted: bool
    gain: float
    error: float
    new: Array
    old: Array

    @property
    def why(self) -> str:
        """The reason in a few words."""
        if self.accepted:
            return "accepted: it improves the estimator on held-out data"
        if _growth(self.new, self.old) > WORSE:
            return "refused: it increases the error on held-out data"
        return "refused: it does not improve the estimator on held-out data"


def judged(names: tuple[str, ...], new: StretchErrors, old: StretchErrors) -> Judgement:
    """Whether ``new`` is better than ``old``: the score improves significantly (jackknife over the stretches) and the error
    does not grow by more than 2 %. The one that fails on more stretches is worse.
    """
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
    """The factor by which the error grows: in position, or the geometric mean over two position coordinates and heading; the
    largest of causal and final.
    """
    position, heading = (new / old)[:, :2].T
    together = np.cbrt(position**2 * np.where(np.isfinite(heading), heading, position))
    return float(np.max((position, together)))

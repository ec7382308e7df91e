"""Marginal covariances of a linear graph, also of one that hardly determines some of its variables.

Cholesky loses half of the digits, and takes a long chain of dead reckoning for indeterminate; QR keeps them (Golub, van Loan,
"Matrix Computations", section 5.3). Where that fails too each variable is held by a share of its own information, the damping.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factors.se2 import Array

DAMPINGS = (0.0, 1e-10, 1e-7)
DAMPED = "covariances: the graph hardly determines them, relative damping of {damping:g}"  # sentence of the event
_NEAR = re.compile(r"variable\s+(\d+)")  # in GTSAM's message about an indeterminate system


class IndeterminateError(RuntimeError):
    """A graph does not determine its variables; ``key``: one of these, None where that is not known."""

    def __init__(self, key: int | None) -> None:
        super().__init__("the solution is not determined")
        self.key = key


@dataclass(frozen=True)
class Covariances:
    """Marginal covariances (d, d) by key, and the relative ``damping`` that they were computed with."""

    by_key: dict[int, Array]
    damping: float


def covariances(graph: gtsam.GaussianFactorGraph, sizes: Mapping[int, int], keys: Sequence[int]) -> Covariances:
    """Marginal covariances of the variables ``keys``; IndeterminateError where no damping helps. ``sizes``: of all variables."""
    result = _solved(graph, keys, robust=False)
    if isinstance(result, dict):
        return Covariances(result, 0.0)
    for damping in DAMPINGS:
        result = _solved(_damped(graph, sizes, damping) if damping else graph, keys, robust=True)
        if isinstance(result, dict):
            return Covariances(result, damping)
    raise result


def blamed(error: Exception) -> int | None:
    """The variable that ours or one of GTSAM's errors names, None where it names none."""
    if isinstance(error, IndeterminateError):
        return error.key
    near = _NEAR.search(str(error))
    return None if near is None else int(near.group(1))


def _solved(
    graph: gtsam.GaussianFactorGraph, keys: Sequence[int], *, robust: bool
) -> dict[int, Array] | IndeterminateError:
    order = gtsam.Ordering.OrderingType.COLAMD
    marginals: dict[int, Array] = {}
    try:
        if not robust:
            tree = graph.eliminateMultifrontal(order)
            marginals = {key: np.asarray(tree.marginalCovariance(key)) for key in keys}
        else:
            tree = graph.eliminateMultifrontal(order, gtsam.EliminateQR)
            for key in keys:
                conditional = tree.marginalFactor(key, gtsam.EliminateQR)  # owns what R() shows
                root = np.linalg.inv(conditional.R())
                marginals[key] = np.asarray(root @ root.T, dtype=float)
    except (RuntimeError, IndexError) as error:  # IndexError: a variable that no factor is on
        return IndeterminateError(blamed(error))
    except np.linalg.LinAlgError:
        return IndeterminateError(key)
    for key, covariance in marginals.items():
        if not (np.all(np.isfinite(covariance)) and np.all(np.diag(covariance) > 0.0)):
            return IndeterminateError(key)
    return marginals


def _damped(graph: gtsam.GaussianFactorGraph, sizes: Mapping[int, int], damping: float) -> gtsam.GaussianFactorGraph:
    """The graph with a prior on each variable. Its information is the share ``damping`` of that of the variable's factors."""
    keys, (_, columns, values) = graph.keyVector(), graph.sparseJacobian_()
    ends = np.cumsum([sizes[key] for key in keys])
    # the last column is that of the right side
    information = np.bincount(columns.astype(np.int64) - 1, values**2, int(ends[-1]) + 1)[:-1]
    out = gtsam.GaussianFactorGraph()
    out.push_back(graph)
    for key, own in zip(keys, np.split(np.sqrt(damping * information), ends[:-1]), strict=True):
        out.add(gtsam.JacobianFactor(key, np.diag(own), np.zeros(len(own)), gtsam.noiseModel.Unit.Create(len(own))))
    return out

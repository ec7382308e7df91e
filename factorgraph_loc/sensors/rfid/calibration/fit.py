"""Penalised maximum-likelihood fits of parametric detection models.

A logit that is linear in its parameters is fitted by Fisher scoring (McCullagh and Nelder, "Generalized Linear Models", 1989,
section 2.5), using the derivatives of the likelihood with its floor; unsuccessful steps are halved.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.optimize import minimize
from scipy.sparse.linalg import splu

from factorgraph_loc.sensors.rfid.calibration.pairs import REACH, TagPairs, terms
from factors.rfid.model import FEATURES, NEAR, BeamModel, LogisticModel, logits
from factors.se2 import Array

FACING = tuple(i for i, name in enumerate(FEATURES) if "c" in name)
RIDGE = 1.0  # penalty on coefficients of features with unit standard deviation, in nats
EDGE = 5.0  # pseudo-rounds without reads at the maximum range, so that extrapolations do not grow with distance
ITERATIONS = 50
CONVERGED = 1e-4  # relative decrease of the cost in the last step


@dataclass(frozen=True)
class Floor:
    """Probabilities of a false read, and of a miss at any position."""

    false_read: float = 0.02
    miss: float = 0.02


def features(points: Array, facing: Array) -> Array:
    """The features (M, 11) of :data:`factors.rfid.model.FEATURES`."""
    x, y, z = points.T
    r = np.sqrt(x**2 + y**2 + NEAR**2)
    w, c = 1.0 - x / r, facing
    return np.column_stack((np.ones_like(r), r, r**2, w, w**2, r * w, np.abs(z), c, c**2, r * c, w * c))


def fit_linear(
    design: Array | sparse.csr_array,
    offset: Array,
    hits: Array,
    count: Array,
    penalty: Array | sparse.csc_array,
    floor: Floor,
) -> Array:
    """Parameters (P,) of the logit ``offset + design @ p`` (M,) that maximise the likelihood minus ``p @ penalty @ p / 2``."""
    values = np.zeros(design.shape[1])

    def cost(p: Array) -> tuple[float, Array, Array]:
        found = terms(offset + design @ p, hits, count, floor.false_read, floor.miss)
        return float(np.sum(found.nll) + 0.5 * p @ (penalty @ p)), found.gradient, found.information

    here, slope, information = cost(values)
    for _ in range(ITERATIONS):
        gradient = design.T @ slope + penalty @ values
        if sparse.issparse(design):
            curvature = design.T @ sparse.diags_array(information) @ design + penalty
            step = splu(
                sparse.csc_matrix(curvature), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
            ).solve(gradient)
        else:
            step = np.linalg.solve(design.T @ (information[:, None] * design) + penalty, gradient)
        size = 1.0
        while (tried := cost(values - size * step))[0] > here and size > 1e-3:
            size *= 0.5
        if tried[0] >= here:
            break
        values, gained = values - size * step, here - tried[0]
        here, slope, information = tried
        if gained < CONVERGED * here:
            break
    return values


def fit_logistic(pairs: TagPairs, floor: Floor, *, with_facing: bool) -> LogisticModel:
    """Fit a logistic model, with or without the features of the tags' facing."""
    edge, edge_facing = _edge()
    design = np.vstack((features(pairs.points, pairs.facing), features(edge, edge_facing)))
    hits = np.concatenate((pairs.hits, np.zeros(len(edge))))
    count = np.concatenate((pairs.count, np.full(len(edge), EDGE / len(edge))))
    if not with_facing:
        design[:, FACING] = 0.0
    mean, spread = np.mean(design, axis=0), np.std(design, axis=0)
    used = np.flatnonzero(spread > 1e-6)
    whitened = np.column_stack((np.ones(len(design)), (design[:, used] - mean[used]) / spread[used]))
    penalty = RIDGE * np.eye(len(used) + 1)
    penalty[0, 0] = 1e-9
    found = fit_linear(whitened, np.zeros(len(design)), hits, count, penalty, floor)
    coefficients = np.zeros(len(FEATURES))
    coefficients[used] = found[1:] / spread[used]
    coefficients[0] = found[0] - float(mean[used] @ coefficients[used])
    return LogisticModel(tuple(coefficients.tolist()), REACH)


def fit_beam(pairs: TagPairs, floor: Floor) -> BeamModel:
    """Fit a beam model."""
    bounds = [(-3.0, 7.0), (np.log(0.3), np.log(2.0 * REACH)), (np.log(0.05), np.log(5.0)), (np.log(0.1), np.log(9.0))]

    def model(p: Array) -> BeamModel:
        return BeamModel(float(1.0 / (1.0 + np.exp(-p[0]))), *np.exp(p[1:]).tolist())

    def cost(p: Array) -> float:
        logit, _ = logits(model(p), pairs.points, pairs.facing)
        return float(np.mean(terms(logit, pairs.hits, pairs.count, floor.false_read, floor.miss).nll))

    start = np.array((2.0, np.log(4.5), np.log(0.5), np.log(0.7)))
    return model(minimize(cost, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": 60}).x)


def _edge() -> tuple[Array, Array]:
    """Positions (E, 3) around the antenna at the maximum range, and facings (E,)."""
    bearing, height, facing = (
        a.ravel()
        for a in np.meshgrid(
            np.linspace(-np.pi, np.pi, 24, endpoint=False), (-1.0, 0.0, 1.0), np.linspace(-1.0, 1.0, 5), indexing="ij"
        )
    )
    return np.column_stack((REACH * np.cos(bearing), REACH * np.sin(bearing), height)), facing

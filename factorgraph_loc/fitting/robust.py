"""Robust fits of a few constants, and selection of the constants worth keeping.

The loss is soft-L1 of whitened residuals, quadratic near zero and linear in the tails (Charbonnier et al., "Two deterministic
half-quadratic regularization algorithms for computed imaging", 1994). Standard errors come from the cluster-robust sandwich
estimator (Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986): residuals within a block of
time may be correlated in any way.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from factors.se2 import Array

LOSS_SCALE = 2.0  # standard deviations at which the loss changes from quadratic to linear
MAD_TO_SIGMA = 1.4826  # of a Gaussian
_STEP = 1e-4  # step of the numerical derivative, in typical sizes
_ITERATIONS = 8  # of the iteratively reweighted linear fit

Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Constant:
    """A constant that can be fitted: its ``neutral`` value (used where it is not fitted), ``typical`` size of a change, and
    bounds.
    """

    name: str
    neutral: float
    typical: float
    low: float
    high: float

    def is_inside(self, value: float) -> bool:
        """Whether a value lies strictly inside the bounds."""
        margin = 1e-3 * self.typical
        return self.low + margin < value < self.high - margin


@dataclass(frozen=True)
class Fit:
    """Fitted ``values`` (P,) with standard ``errors`` (P,), whitened ``residuals`` (M, D) and their ``jacobian`` (M, D, P)."""

    constants: tuple[Constant, ...]
    values: Array
    errors: Array
    residuals: Array
    jacobian: Array

    def as_dict(self) -> dict[str, float]:
        return {c.name: float(v) for c, v in zip(self.constants, self.values, strict=True)}

    def errors_as_dict(self) -> dict[str, float]:
        return {c.name: float(e) for c, e in zip(self.constants, self.errors, strict=True)}


def fit(constants: Sequence[Constant], start: Array, whitened: Callable[[Array], Array], blocks: Integers) -> Fit:
    """Return the constants (P,) that minimise the loss of ``whitened(values)`` (M, D), starting from ``start`` (P,).

    ``blocks`` (M,): the block of time of each row, for the standard errors.
    """
    typical = np.array([c.typical for c in constants])
    low, high = np.array([c.low for c in constants]), np.array([c.high for c in constants])

    def residual(scaled: Array) -> Array:
        return whitened(scaled * typical).ravel()

    def jacobian(scaled: Array) -> Array:
        here = residual(scaled)
        return np.column_stack([(residual(scaled + step) - here) / _STEP for step in _STEP * np.eye(len(scaled))])

    inside = np.clip(start, low + 1e-9 * typical, high - 1e-9 * typical) / typical
    found = scipy.optimize.least_squares(
        residual,
        inside,
        jacobian,
        bounds=(low / typical, high / typical),
        loss="soft_l1",
        f_scale=LOSS_SCALE,
        xtol=1e-4,
        ftol=1e-6,
    )
    values = np.asarray(found.x * typical)
    residuals = whitened(values)
    derivative = jacobian(found.x).reshape(*residuals.shape, -1) / typical
    errors = np.sqrt(np.diag(_sandwich(residuals, derivative, blocks)))
    return Fit(tuple(constants), values, errors, residuals, derivative)


def gains(found: Fit, folds: Integers, given_up: Collection[str] = ()) -> Array:
    """Return the gain (P, K) in held-out loss [nats] of each constant on K folds; positive values favour the constant.

    ``folds`` (M,): the fold of each row. Each fold is predicted from a fit to the others, once with all constants and once with
    one constant at its neutral value; residuals are linearised about the fit to all data. Backward elimination: the constant
    with the least gain is dropped for good if that gain is not positive, and the rest are evaluated again, so that of two
    redundant constants one stays. Constants at a bound, and those in ``given_up``, are dropped from the start.
    """
    neutral = np.array([c.neutral for c in found.constants]) - found.values
    out = np.zeros((len(neutral), int(folds.max()) + 1))
    kept = [p for p, c in enumerate(found.constants) if c.is_inside(float(found.values[p])) and c.name not in given_up]
    while kept:
        complete = _held_out(found, folds, kept, neutral)
        for p in kept:
            out[p] = _held_out(found, folds, [q for q in kept if q != p], neutral) - complete
        useless = [p for p in kept if not is_worth(out[p])]
        if not useless:
            break
        kept.remove(min(useless, key=lambda p: float(np.sum(out[p]))))
    return out


def is_worth(gain: Array) -> bool:
    """Whether the gains (K,) of one constant favour it: in sum, and in more than half of the folds."""
    return bool(np.sum(gain) > 0.0 and np.mean(gain > 0.0) > 0.5)


def blocks(times: Sequence[Array], length: float) -> Integers:
    """Number the blocks of ``length`` seconds of several logs consecutively, and return the block of each time."""
    out: list[Integers] = []
    for t in times:
        offset = int(out[-1].max()) + 1 if out and len(out[-1]) else 0
        out.append(((t - t.min()) // length).astype(np.int64) + offset if len(t) else np.zeros(0, dtype=np.int64))
    return np.concatenate(out)


def folds(times: Sequence[Array], count: int) -> Integers:
    """Return the fold of each row: its log where there are several, else one of ``count`` intervals of the only log."""
    if len(times) > 1:
        return np.repeat(np.arange(len(times)), [len(t) for t in times])
    ranks = np.argsort(np.argsort(times[0], kind="stable"), kind="stable")
    return np.asarray(ranks * count // len(ranks), dtype=np.int64)


def loss(residuals: Array) -> float:
    """Return the soft-L1 loss of whitened residuals, half their squares where they are small."""
    return float(np.sum(LOSS_SCALE**2 * (np.sqrt(1.0 + (residuals / LOSS_SCALE) ** 2) - 1.0)))


def spread(values: Array) -> Array:
    """Return the robust standard deviation (D,) about zero of the columns of ``values`` (M, D)."""
    return np.asarray(MAD_TO_SIGMA * np.nanmedian(np.abs(values), axis=0))


def _held_out(found: Fit, folds: Integers, free: Sequence[int], neutral: Array) -> Array:
    """Return the held-out loss (K,) of each fold, with the constants ``free`` fitted on the others and the rest at neutral
    values.

    ``neutral`` (P,): as changes from the fit to all data.
    """
    fixed = neutral.copy()
    fixed[list(free)] = 0.0
    shifted = found.residuals + found.jacobian @ fixed
    derivative = found.jacobian[..., list(free)]
    out = np.zeros(int(folds.max()) + 1)
    for k in range(len(out)):
        train, test = folds != k, folds == k
        change = np.zeros(len(free))
        flat = derivative[train].reshape(int(np.sum(train)) * derivative.shape[1], len(free))
        for _ in range(_ITERATIONS if len(free) else 0):
            error = shifted[train] + derivative[train] @ change
            weighted = flat / np.sqrt(1.0 + (error.reshape(-1, 1) / LOSS_SCALE) ** 2)
            change = -np.linalg.lstsq(weighted.T @ flat, weighted.T @ shifted[train].ravel(), rcond=None)[0]
        out[k] = loss(shifted[test] + derivative[test] @ change)
    return out


def _sandwich(residuals: Array, jacobian: Array, blocks: Integers) -> Array:
    """Return the cluster-robust covariance (P, P) of the constants."""
    weight = 1.0 / np.sqrt(1.0 + (residuals / LOSS_SCALE) ** 2)
    bread = np.linalg.pinv(np.einsum("mdp,md,mdq->pq", jacobian, weight**3, jacobian))
    scores = np.einsum("mdp,md->mp", jacobian, weight * residuals)
    of_block = np.zeros((int(blocks.max()) + 1, scores.shape[1]))
    np.add.at(of_block, blocks, scores)
    return np.asarray(bread @ (of_block.T @ of_block) @ bread)

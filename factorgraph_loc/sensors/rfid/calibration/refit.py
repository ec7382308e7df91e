"""Parametric detection models with the covariance of their parameters, fitted to pairs from a first guess.

Fisher scoring on the likelihood with its floor, with numerical derivatives of the logits. The covariance is that of a misspecified
likelihood whose contributions are independent between blocks of time only (White, "Maximum likelihood estimation of misspecified
models", Econometrica 50, 1982), at least that of independent reads.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.sensors.rfid.calibration.fit import Floor, fit_logistic
from factorgraph_loc.sensors.rfid.calibration.pairs import TagPairs, terms
from factors.least_squares import minimum
from factors.rfid.model import FEATURES, BeamModel, DetectionModel, LogisticModel, logits
from factors.se2 import Array

ITERATIONS = 30
CONVERGED = 1e-5  # step of a parameter
STEP = 1e-4  # of numerical derivatives
LARGEST = 0.5  # step of a parameter
LOWEST = (-3.0, np.log(0.3), np.log(0.05), np.log(0.1))  # logit of p0, logarithms of r_max, s_r [m] and sigma_phi [rad]
HIGHEST = (7.0, np.log(16.0), np.log(5.0), np.log(9.0))


@dataclass(frozen=True)
class Refit:
    """A ``model``, with ``values`` (P,) of its parameters ``names`` and their standard ``errors`` (P,)."""

    model: DetectionModel
    names: tuple[str, ...]
    values: Array
    errors: Array


def refit_beam(pairs: TagPairs, floor: Floor, start: BeamModel) -> Refit:
    """Fit a beam, from ``start``; the share of reads from behind is that of ``start``."""

    def build(p: Array) -> BeamModel:
        r_max, s_r, sigma_phi = np.exp(p[1:]).tolist()
        return BeamModel(float(1.0 / (1.0 + np.exp(-p[0]))), r_max, s_r, sigma_phi, start.behind)

    low, high = np.array(LOWEST), np.array(HIGHEST)
    p0 = min(max(start.p0, 1e-3), 1.0 - 1e-3)
    p = np.array((np.log(p0 / (1.0 - p0)), *np.log((start.r_max, start.s_r, start.sigma_phi))))
    p, _, _ = minimum(
        lambda p: _fisher(build, p, pairs, floor),
        np.clip(p, low, high),
        ITERATIONS,
        CONVERGED,
        largest=LARGEST,
        low=low,
        high=high,
    )
    model, errors = build(p), _errors(build, p, pairs, floor)
    values = np.array((model.p0, model.r_max, model.s_r, model.sigma_phi))
    return Refit(
        model,
        ("p0", "r_max", "s_r", "sigma_phi"),
        values,
        errors * np.array((model.p0 * (1.0 - model.p0), *values[1:])),
    )


def refit_logistic(pairs: TagPairs, floor: Floor, *, with_facing: bool) -> Refit:
    """Fit a logistic model."""
    model = fit_logistic(pairs, floor, with_facing=with_facing)
    values = np.array(model.coefficients)
    used = np.flatnonzero(values)

    def build(p: Array) -> LogisticModel:
        full = np.zeros(len(FEATURES))
        full[used] = p
        return LogisticModel(tuple(full.tolist()), model.reach)

    names = tuple(f"coefficient of {FEATURES[i]}" for i in used)
    return Refit(model, names, values[used], _errors(build, values[used], pairs, floor))


Build = Callable[[Array], DetectionModel]


def _jacobian(build: Build, p: Array, pairs: TagPairs) -> tuple[Array, Array]:
    """Logits (M,) and their derivatives (M, P)."""
    here = logits(build(p), pairs.points, pairs.facing)[0]
    moved = [logits(build(p + e), pairs.points, pairs.facing)[0] for e in STEP * np.eye(len(p))]
    return here, np.column_stack([(there - here) / STEP for there in moved])


def _fisher(build: Build, p: Array, pairs: TagPairs, floor: Floor) -> tuple[float, Array, Array]:
    """Negative log-likelihood, its gradient (P,) and Fisher information (P, P)."""
    here, jacobian = _jacobian(build, p, pairs)
    found = terms(here, pairs.hits, pairs.count, floor.false_read, floor.miss)
    return float(np.sum(found.nll)), jacobian.T @ found.gradient, jacobian.T @ (found.information[:, None] * jacobian)


def _errors(build: Build, p: Array, pairs: TagPairs, floor: Floor) -> Array:
    """Standard errors (P,)."""
    here, jacobian = _jacobian(build, p, pairs)
    found = terms(here, pairs.hits, pairs.count, floor.false_read, floor.miss)
    spread = np.linalg.pinv(jacobian.T @ (found.information[:, None] * jacobian))
    scores = np.zeros((int(pairs.block.max()) + 1, len(p)))
    np.add.at(scores, pairs.block, found.gradient[:, None] * jacobian)
    robust = spread @ (scores.T @ scores) @ spread
    return np.asarray(np.sqrt(np.maximum(np.diag(robust), np.diag(spread))))

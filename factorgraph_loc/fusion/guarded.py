"""Conversion of an estimator's numerical failures and impossible results to errors of one line.

Every run calls its estimator through a :class:`Guard`. Valid measurements and settings can still make a matrix singular
or a sum overflow. NumPy, GTSAM and compiled code raise different errors then. The guard converts them to a
:class:`~factorgraph_loc.errors.RunFailedError` that names the estimator, the time and the measurement. Errors of the
program (a name, a type, a key) are not converted.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import TracebackType
from typing import Self

import numpy as np

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.fusion.base import Estimator
from factorgraph_loc.model.belief import Belief, PoseEstimate
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.text import plain
from factors import positive
from factors.se2 import Array

# The exceptions that numerical failures raise, such as singular matrices, overflows, and all errors of GTSAM.
FAILURES = (ArithmeticError, ValueError, RuntimeError, IndexError)
ROUNDING = 1e-6  # an eigenvalue of a correlation matrix between minus this value and 0 counts as a rounding error
LEAST = 1e-9  # smaller eigenvalues of a correlation matrix are raised to this value


class Guard:
    """Calls an estimator and converts its exceptions to a RunFailedError.

    Use it as ``guard.process(estimator, measurement)`` or ``with guard.computing(what): ...``. ``who``: the name of the
    estimator, and of the log if there is one, for messages. NumPy's warnings are silenced during these calls.
    """

    def __init__(self, who: str) -> None:
        self._who = who
        self._last: Measurement | None = None  # the last measurement
        self._computing = ""  # the name of the requested result, empty while a measurement is processed
        self._of: float | None = None  # s; the time of the requested result
        self._silence = np.errstate(all="ignore")
        self._is_quiet = False

    @contextmanager
    def quiet(self) -> Iterator[None]:
        """Return a context that silences NumPy's warnings for a whole run. This is faster than to silence them for each
        measurement."""
        with np.errstate(all="ignore"):
            self._is_quiet = True
            try:
                yield
            finally:
                self._is_quiet = False

    def process(self, estimator: Estimator, measurement: Measurement) -> None:
        """Call the estimator's ``process`` with a measurement. Raises RunFailedError if the estimator fails."""
        self._last, self._computing, self._of = measurement, "", None
        with self:
            estimator.process(measurement)

    def computing(self, what: str, t: float | None = None) -> Self:
        """Return a context for a request to the estimator. An exception inside becomes a RunFailedError. ``what``: the
        requested result for the message, such as "the estimate". ``t`` [s]: the time of the result for the message, or
        None."""
        self._computing, self._of = what, t
        return self

    def __enter__(self) -> Self:
        if not self._is_quiet:
            self._silence = np.errstate(all="ignore")
            self._silence.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if not self._is_quiet:
            self._silence.__exit__(None, None, None)
        if isinstance(error, FAILURES) or type(error) is RunFailedError:
            assert error is not None
            raise self._failure(_reason(error)) from error

    def _failure(self, why: str) -> RunFailedError:
        asked = self._computing if self._of is None else f"{self._computing} at {self._of:.3f} s"
        what = asked or (_named(self._last) if self._last is not None else "its start")
        previous = f" (after {_named(self._last)})" if self._computing and self._last is not None else ""
        return RunFailedError(f"{self._who}: {what}{previous}: {why}")


def sound(estimate: PoseEstimate) -> PoseEstimate:
    """Return an estimate with a covariance that is symmetric and positive definite.

    A covariance that is indefinite because of rounding is replaced by the nearest positive definite one. Raises
    ValueError if the pose is not finite, or if the covariance cannot be repaired. An ``unlocalized`` estimate is
    returned unchecked. Call this inside a :class:`Guard`, which converts the error.
    """
    if estimate.status == "unlocalized":
        return estimate
    if estimate.pose.shape != (3,) or estimate.covariance.shape != (3, 3):
        raise ValueError("the estimate is not a pose (3,) with a covariance (3, 3)")
    if not all(map(math.isfinite, estimate.pose.tolist())):
        raise ValueError("the pose is not finite")
    if positive.is_clear(estimate.covariance):
        return estimate
    covariance = _positive(estimate.covariance)
    return estimate if covariance is estimate.covariance else replace(estimate, covariance=covariance)


def sound_belief(belief: Belief) -> Belief:
    """Return a belief with symmetric and positive definite covariances of all modes. Raises ValueError if a covariance
    cannot be repaired, or if a pose or particle is not finite."""
    for values in (belief.particles, belief.weights):
        if values is not None and not np.all(np.isfinite(values)):
            raise ValueError("the particles are not finite")
    if not all(np.all(np.isfinite(mode.pose)) for mode in belief.modes):
        raise ValueError("the pose is not finite")
    modes = tuple(replace(mode, covariance=_positive(mode.covariance)) for mode in belief.modes)
    return replace(belief, modes=modes)


def sound_trajectory(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory with covariances that are symmetric and positive definite. Raises ValueError, with the time
    of the first invalid pose, if a pose is not finite or a covariance cannot be repaired."""
    finite = np.isfinite(trajectory.poses).all(axis=1)
    if not finite.all():
        raise ValueError(f"the pose at {trajectory.t[~finite][0]:.3f} s is not finite")
    if trajectory.covariances is None:
        return trajectory
    doubtful = [i for i, covariance in enumerate(trajectory.covariances) if not positive.is_clear(covariance)]
    if not doubtful:
        return trajectory
    covariances = trajectory.covariances.copy()
    for i in doubtful:
        covariances[i] = _positive(covariances[i], f" at {trajectory.t[i]:.3f} s")
    return replace(trajectory, covariances=covariances)


def _positive(covariance: Array, where: str = "") -> Array:
    """Return the nearest symmetric and positive definite matrix to a ``covariance`` (D, D). Raises ValueError if it
    cannot be repaired. ``where``: a text for the message, such as the time of the pose."""
    repaired = nearest_positive(covariance)
    if repaired is None:
        why = "is not positive definite" if np.all(np.isfinite(covariance)) else "is not finite"
        raise ValueError(f"the covariance{where} {why}")
    return repaired


def nearest_positive(covariance: Array) -> Array | None:
    """Return the symmetric and positive definite matrix nearest to a covariance (D, D). Only rounding errors are
    repaired: returns None if the covariance is more indefinite."""
    sigmas = np.sqrt(np.diag(covariance))
    if not (np.all(np.isfinite(covariance)) and np.all(sigmas > 0.0)):
        return None
    # two divisions, because the product of the standard deviations may overflow
    shares = covariance / sigmas[:, None] / sigmas
    if not np.all(np.isfinite(shares)) or np.abs(shares - shares.T).max() > positive.SKEW:
        return None
    values, vectors = np.linalg.eigh((shares + shares.T) / 2.0)
    if values[0] < -ROUNDING:
        return None
    if values[0] > LEAST and np.linalg.eigvalsh(covariance)[0] > 0.0:
        return covariance
    raised = (vectors * np.maximum(values, LEAST)) @ vectors.T
    repaired = (raised + raised.T) / 2.0 * (sigmas[:, None] * sigmas)
    return repaired if np.all(np.isfinite(repaired)) else None


def _named(measurement: Measurement) -> str:
    return f"{measurement.sensor} at {measurement.t:.3f} s"


def _reason(error: BaseException) -> str:
    """Return the first line of an exception's message that is not empty. If there is none, return the name of its
    type."""
    lines = (" ".join(line.split()) for line in str(error).splitlines())
    return plain(next((line for line in lines if line), type(error).__name__))

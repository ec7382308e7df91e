"""The interface of all estimators."""

from collections.abc import Container, Sequence
from typing import Protocol, runtime_checkable

from factorgraph_loc.model.belief import Belief, Learnt, PoseEstimate, PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Measurement, Tick
from factorgraph_loc.model.trajectory import Trajectory


class _Every:
    """A container that contains every string: ``x in _Every()`` is always true."""

    def __contains__(self, modality: object) -> bool:
        return True


EVERY: Container[str] = _Every()  # the modalities of an estimator that accepts measurements of any sensor


class Estimator(Protocol):
    """An estimator of the robot's pose. It processes measurements in the order of arrival, and returns estimates at any
    time.

    ``diagnostics``: counts and consistency statistics of the run. A class has the attribute ``causal = False`` if its
    estimates are useful only after the last measurement. It has ``smoothed = False`` if its final trajectory equals the
    estimates during the run.

    Only :meth:`initialize`, :meth:`process` and ``forget`` change the estimated values. Calls of other methods never
    change later results.
    """

    diagnostics: Diagnostics

    def initialize(self, prior: PosePrior) -> None:
        """Start from a Gaussian prior of the pose. Before this call every estimate is ``unlocalized``.

        Odometry from before the prior's time may arrive before or after this call, but not after another sensor's first
        measurement. A prior without a heading is allowed if :func:`finds_heading` is true for the estimator. Then no
        estimate has the status ``localized`` before the measurements determine the heading.
        """

    def process(self, measurement: Measurement) -> None:
        """Process one measurement. A measurement that is older than the newest one by more than the setting
        ``max_delay`` is counted and ignored."""

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """Return the pose at the time of the newest measurement, estimated from all measurements so far. If ``t`` [s]
        is later, the pose is predicted by odometry to ``t``."""

    def belief(self, t: float | None = None) -> Belief:
        """Return the probability distribution of the pose, at the same time as :meth:`estimate` with the same ``t``
        [s]. It has Gaussian modes, and particles if the estimator uses them."""

    def learnt(self) -> Learnt:
        """Return the sensor constants and landmarks that are estimated from all measurements so far, with standard
        deviations or covariances."""

    def trajectory(self) -> Trajectory:
        """Return the best estimates of all past poses with covariances, at the times at which the run recorded the
        pose."""


@runtime_checkable
class ConcludingEstimator(Protocol):
    """An estimator that computes its final trajectory in a separate step after the last measurement. This step may add
    diagnostics."""

    def final_diagnostics(self) -> Diagnostics:
        """Return the diagnostics of the run, including those of the final trajectory."""


@runtime_checkable
class ForgettingEstimator(Protocol):
    """An estimator that can delete old parts of its trajectory, so that runs of unlimited length need limited
    memory."""

    def forget(self, until: float) -> None:
        """Delete the trajectory before the time ``until`` [s]. The part that a measurement with a delay up to
        ``max_delay`` can still change is not deleted."""


@runtime_checkable
class RecordingEstimator(Protocol):
    """An estimator that can predict the pose to several times by one call, which is faster than one call per time."""

    def record(self, ticks: Sequence[float]) -> list[PoseEstimate]:
        """Return one estimate for each of ``ticks``, increasing times [s] at which a run records the pose. The
        estimator processes these times like measurements."""


def record_each(estimator: Estimator, ticks: Sequence[float]) -> list[PoseEstimate]:
    """Return the estimate at each of the times ``ticks`` [s]. The estimator also processes each time like a
    measurement, so that its trajectory contains it."""
    estimates = []
    for t in ticks:
        estimates.append(estimator.estimate(t))
        estimator.process(Tick(t))
    return estimates


def finds_heading(estimator: Estimator) -> bool:
    """Return True if the estimator can start with an unknown heading at a known position, or at an unknown position."""
    names = ("supports_unknown_start", "supports_unknown_heading")
    return any(getattr(estimator, name, False) for name in names)

"""The interface that all estimators share, and what they report."""

from collections.abc import Container
from typing import Protocol, runtime_checkable

from factorgraph_loc.model.belief import Belief, Learnt, PoseEstimate, PosePrior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import Measurement
from factorgraph_loc.model.trajectory import Trajectory


class _Every:
    """Contains every modality."""

    def __contains__(self, modality: object) -> bool:
        return True


EVERY: Container[str] = _Every()  # modalities of an estimator that takes whatever sensor there is


class Estimator(Protocol):
    """An estimator. It is given measurements in the order of arrival and can be asked at any time.

    Its class may say ``causal = False``, if its estimates are of no use before the end, and ``smoothed = False``, if its final
    trajectory repeats the causal one.

    Only what it is given changes it: whatever is asked, and however often, all later answers are the same to the last bit.
    """

    diagnostics: Diagnostics

    def initialize(self, prior: PosePrior) -> None:
        """Start from a Gaussian; before that every estimate is ``unlocalized``. Odometry of before the start may come earlier or
        later than this, but not after the first measurement of another kind.

        A prior without a heading needs an estimator for which :func:`finds_heading` is true. No estimate is ``localized``
        before the observations determine the heading.
        """

    def process(self, measurement: Measurement) -> None:
        """Take one measurement; one that is late by more than ``max_delay`` is counted and dropped."""

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """The pose at the newest time seen, from the measurements so far, or at ``t`` if that is later, as the odometry leads."""

    def belief(self, t: float | None = None) -> Belief:
        """The whole belief behind :meth:`estimate`."""

    def learnt(self) -> Learnt:
        """Constants estimated from all measurements, consistent with :meth:`trajectory`."""

    def trajectory(self) -> Trajectory:
        """The best estimate of the whole past, with covariances, at the stamps of the ticks."""


@runtime_checkable
class ConcludingEstimator(Protocol):
    """An estimator that solves a separate problem for its final trajectory. That solution may add diagnostics."""

    def final_diagnostics(self) -> Diagnostics:
        """The diagnostics of the run and of the final solution."""


@runtime_checkable
class ForgettingEstimator(Protocol):
    """An estimator that can run for as long as one likes."""

    def forget(self, until: float) -> None:
        """Drop the trajectory until this time [s], except for the part that late measurements can still change."""


def finds_heading(estimator: Estimator) -> bool:
    """Whether the estimator can start at a position with an unknown heading: who finds its place finds its heading too."""
    names = ("supports_unknown_start", "supports_unknown_heading")
    return any(getattr(estimator, name, False) for name in names)

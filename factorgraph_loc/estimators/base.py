"""The interface that all estimators share, and what they report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, TypeVar, runtime_checkable

import numpy as np

from factorgraph_loc.measurements import Measurement
from factorgraph_loc.points import PointMap
from factorgraph_loc.trajectory import Trajectory
from factorgraph_loc.trajectory3 import Trajectory3
from factors.se2 import Array

Status = Literal["unlocalized", "ambiguous", "localized"]


@dataclass(frozen=True)
class PosePrior:
    """What is known of the start: ``pose`` (3,) at ``t`` with ``covariance`` (3, 3) of (x, y, heading) in the world's frame;
    ``space``: of a robot that is not on a floor. ``has_heading``: False where the heading may be any; that of the pose is 0 then,
    and its variance that of a uniform distribution."""

    t: float
    pose: Array
    covariance: Array
    space: SpacePose | None = None
    has_heading: bool = True

    @staticmethod
    def at_position(t: float, position: Array, covariance: Array) -> PosePrior:
        """At a ``position`` (2,) with ``covariance`` (2, 2), and any heading."""
        whole = np.diag((0.0, 0.0, math.pi**2 / 3.0))
        whole[:2, :2] = covariance
        return PosePrior(t, np.append(position, 0.0), whole, has_heading=False)


@dataclass(frozen=True)
class SpacePose:
    """A robot in space: ``position`` (3,) [m] and ``rotation`` (3, 3) in the world's frame, with the ``covariance`` (6, 6) of its
    perturbation in its own frame, turn first, then shift, as ``gtsam.Pose3`` has them."""

    position: Array
    rotation: Array
    covariance: Array


@dataclass(frozen=True)
class PoseEstimate:
    """A causal estimate: ``pose`` (3,) at ``t`` with ``covariance`` (3, 3) of (x, y, heading) in the world's frame; ``space``: of
    an estimator that knows the robot's pose in space."""

    t: float
    pose: Array
    covariance: Array
    status: Status
    space: SpacePose | None = None


@dataclass(frozen=True)
class Mode:
    """One Gaussian mode of a belief, in the world's frame."""

    weight: float
    pose: Array
    covariance: Array


@dataclass(frozen=True)
class Belief:
    """What an estimator believes now: weighted Gaussian modes, and particles (N, 3) with weights (N,) where it has them."""

    modes: tuple[Mode, ...]
    particles: Array | None = None
    weights: Array | None = None


@dataclass(frozen=True)
class LearntPoint:
    """A landmark's estimated ``position`` (2,) [m] with ``covariance`` (2, 2) of (x, y), in the world's frame."""

    position: Array
    covariance: Array


@dataclass(frozen=True)
class Learnt:
    """What an estimator has estimated on the way, beside the poses.

    ``values``: constants, name to (value, standard deviation), SI units. Those of the odometry have plain names
    (``scale_distance``), those of another sensor its name before them (``bearing_range.x``). ``landmarks``: by the map's or the
    measurements' name. ``points``: those in space that the map lacks, None without any.
    """

    values: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    landmarks: Mapping[str, LearntPoint] = field(default_factory=dict)
    points: PointMap | None = None


@dataclass(frozen=True)
class Mark:
    """How much :class:`Diagnostics` held at a time: numbers of rows, and counts."""

    nis: Mapping[str, int]
    residuals: Mapping[str, int]
    ignored: Mapping[str, int]
    rejected: Mapping[str, int]


@dataclass(frozen=True)
class Written:
    """What was added to :class:`Diagnostics`: its rows, and by how much its counts rose."""

    nis: Mapping[str, Sequence[tuple[float, float, int]]]
    residuals: Mapping[str, Sequence[float]]
    ignored: Mapping[str, int]
    rejected: Mapping[str, int]


NOTHING_WRITTEN = Written({}, {}, {}, {})


@dataclass
class Diagnostics:
    """Counts and consistency figures of a run.

    ``residuals``: by sensor and value (``bearing_range.range`` in m), measurement less prediction, before the update. ``nis``: by
    sensor, rows of (t, normalised innovation squared, degrees of freedom). ``ignored``, ``rejected``, ``late``: counts by reason.
    ``events``: (t, what happened), for example a rebuilt graph. ``dead_tags``: tags of the map that are believed dead now, with the
    probability of it.
    """

    nis: dict[str, list[tuple[float, float, int]]] = field(default_factory=dict)
    residuals: dict[str, list[float]] = field(default_factory=dict)
    ignored: dict[str, int] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)
    late: dict[str, int] = field(default_factory=dict)
    events: list[tuple[float, str]] = field(default_factory=list)
    dead_tags: dict[str, float] = field(default_factory=dict)
    # the last mark, while nothing is written after it: most of what is taken writes nothing
    _mark: Mark | None = field(default=None, init=False, repr=False, compare=False)

    def ignore(self, reason: str, count: int = 1) -> None:
        self._mark = None
        self.ignored[reason] = self.ignored.get(reason, 0) + count

    def reject(self, reason: str, count: int = 1) -> None:
        self._mark = None
        self.rejected[reason] = self.rejected.get(reason, 0) + count

    def drop_late(self, sensor: str, count: int = 1) -> None:
        self.late[sensor] = self.late.get(sensor, 0) + count

    def innovation(self, sensor: str, t: float, nis: float, dof: int) -> None:
        self._mark = None
        self.nis.setdefault(sensor, []).append((t, nis, dof))

    def add_residuals(self, name: str, values: Iterable[float]) -> None:
        self._mark = None
        self.residuals.setdefault(name, []).extend(values)

    def keep_last(self, rows: int) -> None:
        """Forget all but the last ``rows`` of each list."""
        self._mark = None
        for innovations in self.nis.values():
            del innovations[:-rows]
        for residuals in self.residuals.values():
            del residuals[:-rows]
        del self.events[:-rows]

    def copy(self) -> Diagnostics:
        """One of its own with the same content."""
        return Diagnostics(
            {name: list(rows) for name, rows in self.nis.items()},
            {name: list(values) for name, values in self.residuals.items()},
            dict(self.ignored),
            dict(self.rejected),
            dict(self.late),
            list(self.events),
            dict(self.dead_tags),
        )

    def mark(self) -> Mark:
        """What there is now, for :meth:`since`."""
        if self._mark is None:
            self._mark = self._counted()
        return self._mark

    def _counted(self) -> Mark:
        rows, values = ({name: len(found) for name, found in lists.items()} for lists in (self.nis, self.residuals))
        return Mark(rows, values, dict(self.ignored), dict(self.rejected))

    def since(self, mark: Mark) -> Written:
        """What was added since then."""
        if mark is self._mark:
            return NOTHING_WRITTEN
        return Written(
            {name: rows[mark.nis.get(name, 0) :] for name, rows in self.nis.items()},
            {name: values[mark.residuals.get(name, 0) :] for name, values in self.residuals.items()},
            _risen(self.ignored, mark.ignored),
            _risen(self.rejected, mark.rejected),
        )

    def take_back(self, written: Written) -> None:
        """Take out what was added, as what it tells of will be taken once more: a measurement counts once, however often an
        estimator goes back in time. Rows may be gone by now: a robot that runs for long keeps the last ones. What was ``late``
        stays, and so do ``events``, which did happen."""
        self._mark = None
        _remove(self.nis, written.nis)
        _remove(self.residuals, written.residuals)
        for totals, counts in ((self.ignored, written.ignored), (self.rejected, written.rejected)):
            for name, count in counts.items():
                totals[name] -= count
                if not totals[name]:
                    del totals[name]


def _risen(counts: Mapping[str, int], before: Mapping[str, int]) -> dict[str, int]:
    """By how much each of those counts rose that did."""
    rises = {name: count - before.get(name, 0) for name, count in counts.items()}
    return {name: rise for name, rise in rises.items() if rise}


_Row = TypeVar("_Row")


def _remove(lists: dict[str, list[_Row]], taken: Mapping[str, Sequence[_Row]]) -> None:
    """Take rows out of lists, each where it is found last; a list without rows goes too."""
    for name in taken.keys() & lists.keys():
        rows = lists[name]
        for row in reversed(taken[name]):
            found = next((i for i in reversed(range(len(rows))) if rows[i] is row or rows[i] == row), None)
            if found is not None:
                del rows[found]
        if not rows:
            del lists[name]


class Estimator(Protocol):
    """An estimator. It is given measurements in the order of arrival and can be asked at any time.

    Only what it is given changes it: whatever is asked, and however often, all later answers are the same to the last bit.
    """

    diagnostics: Diagnostics

    def initialize(self, prior: PosePrior) -> None:
        """Start from a Gaussian; before that every estimate is ``unlocalized``. Odometry of before the start may come earlier or
        later than this, but not after the first measurement of another kind.

        A prior without a heading is given only to an estimator of which :func:`finds_heading` is true: no estimate is
        ``localized`` until what is seen has told the heading.
        """

    def process(self, measurement: Measurement) -> None:
        """Take one measurement; one that is late by more than ``max_delay`` is counted and dropped."""

    def estimate(self, t: float | None = None) -> PoseEstimate:
        """The pose at the newest time seen, from the measurements so far, or at ``t`` if that is later, as the odometry leads."""

    def belief(self, t: float | None = None) -> Belief:
        """The whole belief behind :meth:`estimate`."""

    def learnt(self) -> Learnt:
        """Constants estimated on the way, with what came later, as :meth:`trajectory` has them."""

    def trajectory(self) -> Trajectory:
        """The best estimate of the whole past, with covariances, at the stamps of the ticks."""


@runtime_checkable
class SpaceEstimator(Protocol):
    """An estimator of a robot that need not be on a floor: its causal estimates hold ``space``."""

    def space_trajectory(self) -> Trajectory3:
        """:meth:`Estimator.trajectory` in space, with covariances (N, 6, 6)."""


@runtime_checkable
class ConcludingEstimator(Protocol):
    """An estimator whose final trajectory is a solution of its own, which may have something to tell."""

    def final_diagnostics(self) -> Diagnostics:
        """The diagnostics, and what the solution adds to them."""


@runtime_checkable
class ForgettingEstimator(Protocol):
    """An estimator that can run for as long as one likes."""

    def forget(self, before: float) -> None:
        """Drop what only the trajectory before that time needs, as far as late measurements cannot change it any more."""


def finds_heading(estimator: Estimator) -> bool:
    """Whether the estimator can start at a position with an unknown heading: who finds its place finds its heading too."""
    names = ("supports_unknown_start", "supports_unknown_heading")
    return any(getattr(estimator, name, False) for name in names)


def gaussian_belief(estimate: PoseEstimate) -> Belief:
    """The belief of an estimator that has one Gaussian; nothing is believed where the estimate is not a number."""
    if not np.isfinite(estimate.pose).all():
        return Belief(())
    return Belief((Mode(1.0, np.array(estimate.pose), np.array(estimate.covariance)),))

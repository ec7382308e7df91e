"""The interface of measurements, frozen values with timestamps in seconds from the start of the log, in SI units; the rows of one
sensor of a log; and the interface of motion sensors (odometry) used for prediction."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from itertools import compress, pairwise
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factors.se2 import Array

if TYPE_CHECKING:
    import gtsam

    from factorgraph_loc.model.settings import Estimated
    from factors.graph import Factor
    from factors.motion import ChainState, Increment


GOING_BACK = 5.0  # s that an estimator goes back in time, at most, for one that is late
SEEN = 2  # rank of exteroceptive streams; motion has lower ranks


class Measurement(Protocol):
    """A measurement at ``t`` [s], the time of the event with the clock offset applied.

    ``sensor``: its channel, as in a log and in ``--sensors``. ``modality``: the kind of sensor, by which estimators declare what
    they use. ``count``: number of detections. ``is_motion``: whether it measures the robot's motion.
    """

    @property
    def t(self) -> float: ...
    @property
    def sensor(self) -> str: ...
    @property
    def modality(self) -> str: ...
    @property
    def count(self) -> int: ...
    @property
    def is_motion(self) -> bool: ...


def named(m: Measurement) -> str:
    """The measurement in an error: ``BearingRange at 1.500 s``."""
    return f"{type(m).__name__} at {m.t:.3f} s"


@dataclass(frozen=True, slots=True)
class Tick:
    """A time at which the causal trajectory is evaluated."""

    sensor: ClassVar[str] = "tick"
    modality: ClassVar[str] = "tick"
    count: ClassVar[int] = 0
    is_motion: ClassVar[bool] = False
    t: float


@dataclass(frozen=True, slots=True)
class Rows:
    """Measurements of one ``kind`` that follow one another in time, as one: their ``times`` (N,) [s], and their ``values``, an
    array (N,) of each field. As a measurement it has the time of the last."""

    kind: type[Any]
    times: Array
    values: tuple[Array, ...]

    @property
    def t(self) -> float:
        return float(self.times[-1])

    @property
    def sensor(self) -> str:
        return str(self.kind.sensor)

    @property
    def modality(self) -> str:
        return str(self.kind.modality)

    @property
    def count(self) -> int:
        return len(self.times)

    @property
    def is_motion(self) -> bool:
        return bool(self.kind.is_motion)

    def part(self, first: int, last: int) -> Rows:
        """Those from ``first`` to before ``last``."""
        return Rows(self.kind, self.times[first:last], tuple([values[first:last] for values in self.values]))


@dataclass(frozen=True)
class Stream:
    """The rows of one channel as columns; ``t`` (N,) in seconds from the start of the log, by the sensor's clock.

    Rows are in order of arrival; a late row has an older timestamp than the one before. ``rank`` orders rows with equal
    timestamps: 0 for wheel odometry, 1 for other motion. ``kind``: class of the measurements, constructed from a timestamp and
    the columns. ``joins``: whether consecutive rows, of numbers, can be one measurement
    (:class:`~factorgraph_loc.model.measurement.Rows`).
    """

    rank: ClassVar[int] = SEEN
    joins: ClassVar[bool] = False
    kind: ClassVar[type[Any]]
    t: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        """One measurement per row; ``offset`` [s] is added to the timestamps."""
        return map(self.kind, (self.t + offset).tolist(), *(np.asarray(column).tolist() for column in self._columns()))

    def rows(self, offset: float) -> Rows:
        """All rows as one measurement, if the stream ``joins``."""
        return Rows(self.kind, self.t + offset, tuple(np.array(column, dtype=float) for column in self._columns()))

    def _columns(self) -> Iterator[Any]:
        return (getattr(self, field.name) for field in fields(self)[1:])

    def begun_anew(self) -> Self:
        """The stream of a robot that was placed at its first row, without any motion before it."""
        return self

    def scans(self) -> Iterator[tuple[int, int]]:
        """First and end row of each run of equal timestamps."""
        return pairwise([*np.flatnonzero(np.diff(self.t, prepend=np.nan) != 0.0).tolist(), len(self.t)])


@dataclass(frozen=True)
class ScanStream(Stream):
    """A stream in which the rows of one timestamp form one measurement, made of names (K,) and arrays (K,)."""

    def measurements(self, offset: float) -> Iterator[Measurement]:
        """One measurement per timestamp; ``offset`` [s] is added to the timestamps."""
        for i, j in self.scans():
            parts = (column[i:j] for column in self._columns())
            values = (part if isinstance(part, np.ndarray) else tuple(part) for part in parts)
            yield self.kind(float(self.t[i]) + offset, *values)


def selected(stream: Stream, keep: NDArray[np.bool_]) -> Stream:
    columns = {f.name: getattr(stream, f.name) for f in fields(stream)}
    kept: dict[str, Any] = {
        k: v[keep] if isinstance(v, np.ndarray) else list(compress(v, keep)) for k, v in columns.items()
    }
    return replace(stream, **kept)


def joined(first: Stream, second: Stream) -> Stream:
    if type(first) is not type(second):
        kinds = f"{type(first).__name__} and one with {type(second).__name__}"
        raise InputError(f"a log with {kinds} cannot be joined, expected tables of the same kind")
    columns = {f.name: (getattr(first, f.name), getattr(second, f.name)) for f in fields(first)}
    both: dict[str, Any] = {
        k: np.concatenate((a, b)) if isinstance(a, np.ndarray) else [*a, *b] for k, (a, b) in columns.items()
    }
    return replace(first, **both)


class Motion(Protocol):
    """A motion sensor: collects rows and gives the relative motion between any two recent times.

    ``constants``: the P calibration constants that are estimated. ``horizon`` [s]: how long rows are kept.
    """

    constants: Estimated
    horizon: float

    def add(self, m: Any) -> None:
        """Add a row, or :class:`~factorgraph_loc.model.measurement.Rows`. Unused rows are counted as ignored, those older than the
        kept rows as late."""

    def keep(self, horizon: float) -> None:
        """Keep the rows of the last ``horizon`` seconds."""

    def state(self, t: float) -> ChainState:
        """The state of the integrated odometry at ``t``. Raises RunFailedError if the rows of then are no longer kept."""

    def relative(self, start: ChainState, end: ChainState) -> Increment:
        """The relative motion between two states, with its covariance."""

    def travelled(self, start: ChainState, t: float) -> tuple[ChainState, Increment]:
        """The state at ``t``, and the relative motion from ``start`` to it."""

    def moved(
        self, start: ChainState, t: float, pose: Array, covariance: Array, constants: Array
    ) -> tuple[Array, Array, Array]:
        """A pose (3,) with body-frame ``covariance`` (3, 3) at ``start``, moved to ``t``, for ``constants`` (P,): the pose, and its
        covariance in the body frame and in the world frame."""

    def relatives(self, starts: Array, ends: Array, constants: Array) -> tuple[Array, Array]:
        """The relative motions between states (N, 8), for ``constants`` (P,): poses (N, 3) and covariances (N, 3, 3)."""

    def changed(self, increment: Increment, constants: Array) -> tuple[Array, Array]:
        """Corrected ``delta`` (3,) of an increment for ``constants`` (P,), and its Jacobian (3, P) in the tangent space."""

    def predicted(
        self, start: ChainState, t: float, pose: Array, covariance: Array, constants: Array, first: int
    ) -> tuple[ChainState, Array, Array, Array, Array]:
        """Predict a Gaussian from ``start`` to ``t``: the state there, the pose (3,), the first rows (3, S) of the transition (the
        other rows are those of the identity), the covariance (3, 3) that the motion adds to the first three components, and the
        covariance (S, S) of the error state, in which the columns of ``constants`` (P,) begin at ``first``."""

    def recalibrated(self, increment: Increment, constants: Array) -> Increment:
        """An increment corrected for ``constants`` (P,)."""

    def poses_at(self, start: ChainState, t: Array, constants: Array) -> Array:
        """Poses (R, 3) at times (R,) relative to the pose at ``start``, for ``constants`` (P,)."""

    def twist(self, t: float) -> Array:
        """The robot's velocity (3,) just before ``t``, in the robot frame."""

    def factor(self, increment: Increment, *, scale_known: bool) -> Factor:
        """An increment as a factor on two poses, and on the constants if there are any. ``scale_known``: whether anything else than
        the motion tells the scale of what is estimated."""

    def slip(self, increment: Increment) -> tuple[Array, float]:
        """The covariance (3, 3) that an increment has more if wheels slip, and minus the logarithm of how probable that is."""

    def exact_factor(self, increment: Increment) -> Factor:
        """An increment without constants as a factor on two poses."""

    def native(self, keys: tuple[int, int], increment: Increment) -> gtsam.NonlinearFactor:
        """An increment without constants as a GTSAM factor on two poses."""

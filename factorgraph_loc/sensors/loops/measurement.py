"""Measurements of loops, their stream, and their tables: with the age of the earlier pose, or with its own timestamp."""

from dataclasses import dataclass
from typing import Any, ClassVar

from factorgraph_loc.files.columns import (
    ANGLE,
    DURATION,
    FULL_TURN,
    LATEST,
    LENGTH,
    LONGEST_RANGE,
    MAX_SPAN,
    PURE,
    STAMP,
    STAMPS,
    Table,
    number,
)
from factorgraph_loc.model.measurement import ScanStream
from factors.se2 import Array

LEAST_AGE = 1e-6  # s
_TOLD = (
    *(
        number(name, LENGTH, -LONGEST_RANGE, LONGEST_RANGE, "position in the frame of the earlier pose", may_lack=True)
        for name in "xy"
    ),
    number("heading", ANGLE, -FULL_TURN, FULL_TURN, "heading in the frame of the earlier pose", may_lack=True),
    number("score", PURE, 0.0, 1.0, "how sure the other program is; 1 if it is empty", may_lack=True),
)
_OPTIONAL = ((("x", "y", "heading"), ()), (("score",), ()))

LOOPS = Table(
    "loops",
    (STAMP, number("age", DURATION, LEAST_AGE, MAX_SPAN, "time since the earlier pose"), *_TOLD),
    "one measurement",
    stream="factorgraph_loc.sensors.loops.measurement:LoopStream",
    optional=_OPTIONAL,
)
LOOPS_BY_STAMP = Table(
    "loops",
    (STAMP, number("before_ns", STAMPS, -LATEST, LATEST, "time of the earlier pose, by the same clock"), *_TOLD),
    "one measurement",
    optional=_OPTIONAL,
)


@dataclass(frozen=True, slots=True)
class Loops:
    """Places of earlier times that are met again at one time.

    ``age`` (K,) [s]: time since the earlier pose. ``x``, ``y`` (K,) [m] and ``heading`` (K,) [rad]: the pose in the frame of the
    earlier one, NaN if only the place is known to be the same. ``score`` (K,): 0 to 1, NaN if there is none.
    """

    sensor: ClassVar[str] = "loops"
    modality: ClassVar[str] = "loops"
    is_motion: ClassVar[bool] = False
    t: float
    age: Array
    x: Array
    y: Array
    heading: Array
    score: Array

    @property
    def count(self) -> int:
        """Number of loops."""
        return len(self.age)


@dataclass(frozen=True)
class LoopStream(ScanStream):
    """Rows of loops: age [s], relative pose [m, m, rad] and score, NaN if not given. Rows of one timestamp form one measurement."""

    kind: ClassVar[type[Any]] = Loops
    age: Array
    x: Array
    y: Array
    heading: Array
    score: Array

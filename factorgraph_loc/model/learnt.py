"""Estimates besides the poses: constants of sensors, landmarks, points."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from factorgraph_loc.maps.points import PointMap
from factors.se2 import Array


@dataclass(frozen=True)
class LearntPoint:
    """Estimated ``position`` (2,) [m] of a landmark with ``covariance`` (2, 2) of (x, y), in the world frame."""

    position: Array
    covariance: Array


def learnt_landmarks(blocks: Iterable[tuple[str, Array, Array]]) -> dict[str, LearntPoint]:
    """The landmarks among ``blocks``, each ``SENSOR/NAME`` with its mean and covariance, by name; points in space are none."""
    return {name.partition("/")[2]: LearntPoint(mean, spread) for name, mean, spread in blocks if len(mean) == 2}


@dataclass(frozen=True)
class Learnt:
    """Estimates besides the poses.

    ``values``: constants by name, each (value, standard deviation) in SI units. Constants of odometry have plain names
    (``scale_distance``), those of other sensors a prefix (``bearing_range.x``). ``landmarks``: by name. ``points``: points in
    space that are not in the map, or None.
    """

    values: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    landmarks: Mapping[str, LearntPoint] = field(default_factory=dict)
    points: PointMap | None = None

"""What an estimator has estimated beside the poses."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from factorgraph_loc.maps.points import PointMap
from factors.se2 import Array


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

"""Measured positions of the robot: their types, the columns of their files, and the settings of the sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from factorgraph_loc.files.columns import LENGTH, STAMP, Table, number, within
from factorgraph_loc.files.models import FARTHEST, InUnit
from factorgraph_loc.model.measurement import Stream
from factorgraph_loc.model.settings import Offset, SensorSettings
from factorgraph_loc.sensors.tables import Reading, stream_of
from factorgraph_loc.text import Notice, notice
from factors import se2
from factors.se2 import Array

if TYPE_CHECKING:
    from factorgraph_loc.files.tables import TableRows

AREA, DEGREES = {"m^2": 1.0}, {"deg": 1.0}
LARGEST = 1e308  # m^2; some systems report such a variance as a placeholder
ORIGIN = "origin of latitudes and longitudes"
VARIANCES = ("var_x", "cov_xy", "var_y")
_POINT = {axis: f"pose.position.{axis}" for axis in "xy"}
_COVARIANCE = dict(zip(VARIANCES, ("covariance[0]", "covariance[1]", "covariance[7]"), strict=True))
_SPREAD = tuple(
    number(name, AREA, -LARGEST, LARGEST, "element of the position's covariance; ignored if implausible", may_lack=True)
    for name in VARIANCES
)
POSITIONS = Table(
    "position",
    (
        STAMP,
        within("x", LENGTH, FARTHEST, "position in the world"),
        within("y", LENGTH, FARTHEST, "position in the world"),
        *_SPREAD,
    ),
    stream="factorgraph_loc.sensors.positions.measurement:PositionStream",
    optional=(VARIANCES,),
    messages={
        "geometry_msgs/msg/PointStamped": {axis: f"point.{axis}" for axis in "xy"},
        "geometry_msgs/msg/PoseStamped": _POINT,
        "geometry_msgs/msg/PoseWithCovarianceStamped": {
            name: f"pose.{path}" for name, path in (_POINT | _COVARIANCE).items()
        },
        "nav_msgs/msg/Odometry": {name: f"pose.{path}" for name, path in (_POINT | _COVARIANCE).items()},
    },
)
POSITIONS_ON_EARTH = Table(
    "position",
    (
        STAMP,
        number("latitude", DEGREES, -89.0, 89.0, "geodetic latitude"),
        number("longitude", DEGREES, -180.0, 360.0, "longitude"),
        *_SPREAD,
    ),
    optional=(VARIANCES,),
    messages={
        "sensor_msgs/msg/NavSatFix": {
            "latitude": "latitude",
            "longitude": "longitude",
            **{name: f"position_covariance[{i}]" for name, i in zip(VARIANCES, (0, 1, 4), strict=True)},
        }
    },
)
# the ellipsoid of WGS 84: its semi-major axis [m], and the square of its eccentricity
MAJOR, ECCENTRICITY = 6378137.0, 6.69437999014e-3
# m^2; receivers report variances outside of these bounds, such as 0 or 9999, if the variance is unknown
PLAUSIBLE = (1e-6, 2500.0)


@dataclass(frozen=True, slots=True)
class Position:
    """A measured position ``x``, ``y`` [m] in the world frame at the time ``t`` [s]. ``var_x``, ``cov_xy``, ``var_y``
    [m^2]: the elements of its covariance, NaN if unknown."""

    sensor: ClassVar[str] = "position"
    modality: ClassVar[str] = "position"
    is_motion: ClassVar[bool] = False
    count: ClassVar[int] = 1
    t: float
    x: float
    y: float
    var_x: float = np.nan
    cov_xy: float = np.nan
    var_y: float = np.nan
    source: str = modality


@dataclass(frozen=True)
class PositionStream(Stream):
    """All N measured positions of a log. ``x``, ``y`` (N,) [m]: positions in the world frame. ``var_x``, ``cov_xy``,
    ``var_y`` (N,) [m^2]: the elements of their covariances, NaN if unknown."""

    kind: ClassVar[type[Any]] = Position
    x: Array
    y: Array
    var_x: Array
    cov_xy: Array
    var_y: Array


def are_plausible(var_x: Any, cov_xy: Any, var_y: Any) -> Any:
    """Return True for plausible covariances. Return False for NaN and for variances that are zero, negative or extreme,
    which some receivers report. The arguments are the elements [m^2] of one covariance, or arrays (N,) of the elements
    of N covariances."""
    low, high = PLAUSIBLE
    ranges = (low <= var_x) & (var_x <= high) & (low <= var_y) & (var_y <= high)
    return ranges & (np.abs(cov_xy) < np.sqrt(np.abs(var_x)) * np.sqrt(np.abs(var_y)))


class PositionSettings(SensorSettings):
    """Settings of a system that measures the position of a point on the robot."""

    x: Offset = 0.0
    """position of the measured point on the robot, forward"""
    y: Offset = 0.0
    """position of the measured point on the robot, to the left"""
    sigma: Annotated[float, Field(ge=1e-4, le=100.0), InUnit("m")] = 0.3
    """standard deviation of x and y if the log has no plausible covariance"""
    robust: Annotated[float, Field(ge=0.01, le=100.0)] = 4.0
    """scale of the Geman-McClure loss, in standard deviations"""

    def covariance(self, m: Position) -> Array:
        """Return the covariance (2, 2) [m^2] of a measured position. If the covariance in the measurement is
        implausible, the variances of x and y are ``sigma`` squared."""
        if are_plausible(m.var_x, m.cov_xy, m.var_y):
            return np.array(((m.var_x, m.cov_xy), (m.cov_xy, m.var_y)))
        return self.sigma**2 * np.eye(2)


def assemble(rows: Mapping[str, TableRows], reading: Reading) -> Stream:
    """Return the positions of a log as a stream. ``rows``: the rows by table name. Missing covariances are NaN.

    Latitudes and longitudes become metres to the east and north of the first position. This origin is the same for all
    sensors of a log. ``reading``: the time origin, a list to append warnings to, and values that sensors share.
    """
    (table,) = rows.values()
    if "latitude" in table.numbers:
        table = _with_fix(table, reading.warnings)
    columns = {name: np.full(len(table.rows), np.nan) for name in VARIANCES} | dict(table.numbers)
    if "latitude" in columns:
        for column in POSITIONS_ON_EARTH.columns[1:3]:
            column.require(table.path, table.rows, columns[column.name])
        degrees = np.column_stack((columns.pop("latitude"), columns.pop("longitude")))
        is_first = len(degrees) > 0 and ORIGIN not in reading.shared
        if is_first:
            reading.shared[ORIGIN] = degrees[:1]
        columns |= dict(zip("xy", on_map(degrees, reading.shared.get(ORIGIN, degrees)).T, strict=True))
        if is_first:
            sentence = (
                "position: x points east and y north; the origin is the first position, latitude {latitude}, "
                "longitude {longitude}"
            )
            reading.warnings.append(notice("origin", sentence, *degrees[0]))
    return stream_of(POSITIONS, replace(table, numbers=columns), reading.t0_ns, reading.warnings)


def _with_fix(table: TableRows, warnings: list[Notice]) -> TableRows:
    """Return the rows of ``table`` with a GNSS fix. Without a fix, receivers report latitude 0 and longitude 0. A
    warning about the removed rows is appended to ``warnings``."""
    none = (table.numbers["latitude"] == 0.0) & (table.numbers["longitude"] == 0.0)
    if not none.any() or none.all():
        return table
    sentence = "{source}:{row}: latitude and longitude are 0, in the first of {rows} rows without a fix: skipped"
    first = table.rows[none.argmax()]
    warnings.append(notice("no_fix", sentence, table.path, first, np.count_nonzero(none)))
    return table.rows_at(np.flatnonzero(~none))


def on_map(degrees: Array, origin: Array) -> Array:
    """Return the positions (N, 2) [m], east and north of ``origin`` (1, 2) [deg], of ``degrees`` (N, 2): latitudes and
    longitudes [deg].

    The result is accurate within some kilometres. It is the arc length on the radii of curvature at the origin (Groves,
    "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems", 2nd edition, 2013, section 2.4.2).
    """
    latitude = np.radians(origin[:, 0])
    root = 1.0 - ECCENTRICITY * np.sin(latitude) ** 2
    meridian, normal = MAJOR * (1.0 - ECCENTRICITY) / root**1.5, MAJOR / np.sqrt(root)
    north, east = np.radians(degrees - origin).T
    return np.column_stack((se2.wrap(east) * normal * np.cos(latitude), north * meridian))

"""Measurements of identified landmarks: their types, the columns of their files, and the settings of the sensor."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from factorgraph_loc.files.column_mapping import ColumnMapping, read_mapped
from factorgraph_loc.files.columns import (
    ANGLE,
    FULL_TURN,
    LENGTH,
    LONGEST_RANGE,
    NEAREST,
    STAMP,
    Table,
    named,
    number,
    within,
)
from factorgraph_loc.files.models import FARTHEST, Coordinate, FileModel, InUnit, inside, parse_model
from factorgraph_loc.files.tables import rows_by_name
from factorgraph_loc.model.measurement import ScanStream
from factorgraph_loc.model.settings import Angle, Covariance, Hertz, Metres, Offset, SensorSettings, spread_of
from factors.landmarks.model import PARAMETERS, BearingRangeModel
from factors.se2 import Array

BEARING_RANGE = Table(
    "bearing_range",
    (
        STAMP,
        named("landmark", "the name of a landmark"),
        # radios report 0 without an answer, and gross errors may be negative: such ranges are treated as missing
        number(
            "range",
            LENGTH,
            -LONGEST_RANGE,
            LONGEST_RANGE,
            "distance; a value below 0.001 is skipped",
            may_lack=True,
            left_out_below=NEAREST,
        ),
        number("bearing", ANGLE, -FULL_TURN, FULL_TURN, "direction in the sensor frame", may_lack=True),
    ),
    stream="factorgraph_loc.sensors.landmarks.measurement:BearingRangeStream",
    is_scan=True,
)


@dataclass(frozen=True, slots=True)
class BearingRange:
    """A measurement of K identified landmarks at the time ``t`` [s].

    ``landmarks``: the names of the landmarks. ``range`` (K,) [m]: NaN if not measured. ``bearing`` (K,) [rad]: the
    direction in the sensor frame, NaN if not measured. ``source``: the name of the sensor.
    """

    sensor: ClassVar[str] = "bearing_range"
    modality: ClassVar[str] = "bearing_range"
    is_motion: ClassVar[bool] = False
    t: float
    landmarks: tuple[str, ...]
    range: Array
    bearing: Array
    source: str = modality

    @property
    def count(self) -> int:
        """The number of sighted landmarks."""
        return len(self.landmarks)


@dataclass(frozen=True)
class BearingRangeStream(ScanStream):
    """All sightings of a log, one landmark per row. Rows of one timestamp form one measurement. ``landmark``: N names.
    ``range`` (N,) [m], ``bearing`` (N,) [rad]: NaN if not measured."""

    kind: ClassVar[type[Any]] = BearingRange
    landmark: Sequence[str]
    range: Array
    bearing: Array


class BearingRangeUncertainty(FileModel):
    """Standard deviations of calibration constants of the sensor before a run. Constants with values above 0 are
    estimated."""

    x: Annotated[float, Field(ge=0.0, le=10.0), InUnit("m")] = 0.0
    """standard deviation of the sensor's x"""
    y: Annotated[float, Field(ge=0.0, le=10.0), InUnit("m")] = 0.0
    """standard deviation of the sensor's y"""
    bearing_bias: Annotated[float, Field(ge=0.0, le=1.0), InUnit("rad")] = 0.0
    """standard deviation of the bearing bias"""
    range_scale: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """relative standard deviation of the range scale"""
    range_bias: Annotated[float, Field(ge=0.0, le=10.0), InUnit("m")] = 0.0
    """standard deviation of the range bias, which is constant for each landmark; the particle filter does not estimate it"""
    depth_axis: Annotated[float, Field(ge=0.0, le=1.0), InUnit("rad")] = 0.0
    """standard deviation of the direction of the depth axis"""
    time_offset: Annotated[float, Field(ge=0.0, le=1.0), InUnit("s")] = 0.0
    """standard deviation of the time offset"""


class BearingRangeSettings(SensorSettings):
    """Mounting, constants and noise of a landmark sensor. The model is
    :class:`factors.landmarks.model.BearingRangeModel`."""

    constants: ClassVar[tuple[str, ...]] = PARAMETERS
    x: Offset = 0.0
    """position of the sensor on the robot, forward"""
    y: Offset = 0.0
    """position of the sensor on the robot, to the left"""
    z: Offset = 0.0
    """height of the sensor; ranges to landmarks at another height are slant ranges"""
    heading: Angle = 0.0
    """direction of the sensor on the robot"""
    bearing_bias: Angle = 0.0
    """reported minus true bearing"""
    range_scale: Annotated[float, Field(ge=0.2, le=5.0)] = 1.0
    """reported divided by true range"""
    range_kind: Literal["distance", "depth"] = "distance"
    """meaning of a range: the distance, or the depth along one axis (a camera measures depth by the size of a marker)"""
    depth_axis: Angle = 0.0
    """direction of the depth axis in the sensor frame"""
    range_sigma: Annotated[float, Field(ge=1e-4, le=10.0), InUnit("m")]
    """constant part of the standard deviation of a range r, which is the root of range_sigma^2 + (range_sigma_relative r)^2"""
    range_sigma_relative: Annotated[float, Field(ge=0.0, le=1.0), InUnit("m per m")] = 0.0
    """part of the standard deviation that grows with the range"""
    bearing_sigma: Annotated[float, Field(ge=1e-5, le=0.5), InUnit("rad")] = 0.05
    """standard deviation of a bearing"""
    robust: Annotated[float, Field(ge=0.01, le=100.0)] = 4.0
    """scale of the Geman-McClure loss, in standard deviations"""
    late: Annotated[float, Field(ge=0.0, le=0.99)] = 0.1
    """prior probability that some ranges without bearing are too long (late); their fraction and excess are estimated"""
    uncertainty: BearingRangeUncertainty = BearingRangeUncertainty()
    """standard deviations of constants; a constant is estimated if its value is above 0"""

    def model(self) -> BearingRangeModel:
        return BearingRangeModel(
            mounting=(self.x, self.y, self.heading),
            bearing_bias=self.bearing_bias,
            range_scale=self.range_scale,
            depth=self.range_kind == "depth",
            depth_axis=self.depth_axis,
            range_sigma=self.range_sigma,
            range_sigma_relative=self.range_sigma_relative,
            bearing_sigma=self.bearing_sigma,
            robust=self.robust,
        )


class SightingSettings(FileModel):
    """Rate and visibility of simulated landmark sightings. Walls hide landmarks."""

    rate: Hertz = 2.0
    """measurements per second"""
    max_range: Metres = 6.0
    """largest distance at which a landmark is visible"""
    field_of_view: Annotated[float, Field(ge=0.01, le=6.3), InUnit("rad")] = 6.3
    """full angle of the field of view, centred on the sensor's axis"""
    bearings: bool = True
    """whether bearings are measured; a radio measures ranges alone"""
    late: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """share of late ranges, which are too long"""
    late_by: Metres = 0.5
    """excess of a late range"""


class Landmark(FileModel):
    """A point landmark of the map, with position and height ``z`` [m] in the world frame.

    ``sigma``: standard deviation [m] of the surveyed x and y. ``covariance``: the elements (xx, xy, yy) [m^2] of the
    covariance of the survey, as an alternative to ``sigma``.
    """

    x: Coordinate
    y: Coordinate
    z: Coordinate = 0.0
    sigma: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    covariance: Covariance | None = None

    def spread(self) -> Array:
        """Return the covariance (2, 2) of the surveyed position [m^2]."""
        return spread_of(self.sigma, self.covariance)


def points_of(landmarks: Iterable[Landmark], z: float) -> Array:
    """Return the positions (K, 2) [m] of K landmarks at the height ``z`` [m] of the sensor. If one has another height,
    return (K, 3) with the height above the sensor in the last column."""
    places = np.array([(mark.x, mark.y, mark.z - z) for mark in landmarks]).reshape(-1, 3)
    return places if places[:, 2].any() else np.ascontiguousarray(places[:, :2])


SIGMAS = ("sigma", "sigma_x", "sigma_y")
LANDMARKS = Table(
    "landmarks",
    (
        named("landmark", "the name of a landmark"),
        within("x", LENGTH, FARTHEST, "position in the world"),
        within("y", LENGTH, FARTHEST, "position in the world"),
        within("z", LENGTH, FARTHEST, "height"),
        *(number(name, LENGTH, 0.0, 100.0, "standard deviation of the survey", may_lack=True) for name in SIGMAS),
    ),
)


def read_layer(content: Any, source: object, folder: Path) -> Any:
    """Return the landmarks of a world file. If its section ``landmarks`` names a table, they are read from the table.

    ``content``: the section. For a table, it assigns columns to the fields landmark, x, y and optionally z. It also
    assigns columns to sigma or both sigma_x and sigma_y. The larger of the two is used. ``source``: the name of the
    world file in messages. ``folder``: the folder of the table. Raises InputError for an invalid value or a duplicate
    name.
    """
    if not isinstance(content, dict) or not isinstance(content.get("file"), str):
        return content
    mapping = parse_model(ColumnMapping, content, f"{source} [landmarks]")
    position = ("landmark", "x", "y", *(("z",) if "z" in mapping.columns else ()))
    path = inside(folder, mapping.file, source)
    cells = read_mapped(path, mapping, (position, (*position, "sigma"), (*position, "sigma_x", "sigma_y")))
    if "sigma_x" in cells.columns:
        larger = np.fmax(*(cells.numbers(name, LANDMARKS[name]) for name in ("sigma_x", "sigma_y")))
        cells = replace(cells, columns={name: cells.columns[name] for name in position} | {"sigma": larger})
    return rows_by_name(Landmark, cells, LANDMARKS, cells.texts("landmark"))

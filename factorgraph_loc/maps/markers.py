"""Fiducial markers of a map, such as AprilTags: squares whose four corners a camera observes as named points."""

import math
from collections.abc import Mapping
from typing import Annotated, Literal, get_args

import numpy as np
import scipy
from pydantic import Field

from factorgraph_loc.files.models import Coordinate, FileModel, InUnit
from factorgraph_loc.maps.points import PointMap
from factors.se2 import Array

# "tag36h11" is the AprilTag family with 36 bits and Hamming distance 11; "4x4_50" are 50 ArUco markers of 4 x 4 bits
MarkerFamily = Literal[
    "tag16h5",
    "tag25h9",
    "tag36h10",
    "tag36h11",
    "aruco_original",
    "aruco_mip_36h12",
    "4x4_50",
    "4x4_100",
    "4x4_250",
    "4x4_1000",
    "5x5_50",
    "5x5_100",
    "5x5_250",
    "5x5_1000",
    "6x6_50",
    "6x6_100",
    "6x6_250",
    "6x6_1000",
    "7x7_50",
    "7x7_100",
    "7x7_250",
    "7x7_1000",
]

Turn = Annotated[float, Field(ge=-2.0 * math.pi, le=2.0 * math.pi), InUnit("rad")]
# corners of a marker of size 1 with its normal along x, y to the right seen from the front, and z up; order of ArUco detectors
CORNERS = np.array(((0.0, -0.5, 0.5), (0.0, 0.5, 0.5), (0.0, 0.5, -0.5), (0.0, -0.5, -0.5)))
CORNER_NUMBERS = tuple(str(i) for i in range(len(CORNERS)))


class Marker(FileModel):
    """A square marker in the map.

    ``x``, ``y``, ``z``: position of its centre in the world [m]. ``size``: side of the black square [m]. ``facing``:
    heading of its normal [rad]. ``pitch``: upward tilt of its normal [rad], -pi/2 on a ceiling. ``roll``:
    counter-clockwise rotation seen from the front [rad]. ``sigma``: standard deviation of each coordinate [m].
    """

    x: Coordinate
    y: Coordinate
    z: Coordinate
    size: Annotated[float, Field(ge=1e-3, le=10.0), InUnit("m")]
    facing: Turn
    pitch: Annotated[float, Field(ge=-1.6, le=1.6), InUnit("rad")] = 0.0
    roll: Turn = 0.0
    sigma: Annotated[float, Field(ge=0.0, le=10.0), InUnit("m")] = 0.0

    def corners(self) -> Array:
        """Return the corners (4, 3) [m] in the world: upper left, upper right, lower right, lower left for a viewer."""
        turn = scipy.spatial.transform.Rotation.from_euler("ZYX", (self.facing, -self.pitch, self.roll))
        return np.asarray(turn.apply(self.size * CORNERS) + np.array((self.x, self.y, self.z)))


class MarkerSettings(FileModel):
    """Settings of the detection of square markers in images. ``family``: the family of markers to detect."""

    family: MarkerFamily


def corner_names(marker: str) -> list[str]:
    """Return the names of a marker's corners as points of a map, in the order of :meth:`Marker.corners`."""
    return [f"{marker}/{i}" for i in CORNER_NUMBERS]


def marker_of(point: str) -> str | None:
    """Return the name of the marker that has ``point`` as a corner. ``point``: the name of a point of the map. Returns
    None if the point is no corner of a marker."""
    marker, _, corner = point.rpartition("/")
    is_corner = corner in CORNER_NUMBERS and marker.rpartition("-")[0] in get_args(MarkerFamily)
    return marker if is_corner else None


def corner_points(markers: Mapping[str, Marker]) -> PointMap:
    """Return the corners of all ``markers`` (by name) as a map of named points."""
    names = [name for marker in markers for name in corner_names(marker)]
    positions = np.array([marker.corners() for marker in markers.values()]).reshape(-1, 3)
    covariances = np.array([marker.sigma**2 * np.eye(3) for marker in markers.values() for _ in CORNERS]).reshape(
        -1, 3, 3
    )
    return PointMap.of(names, positions, covariances)

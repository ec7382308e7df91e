"""What the sensors of a robot report: frozen values, stamped in seconds from the log's start, in SI units.

Stamps are those of the event, with the known offsets between clocks already applied.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factors.se2 import Array


@dataclass(frozen=True, slots=True)
class VelocityOdometry:
    """Forward velocity ``v`` [m/s] and turn rate ``w`` [rad/s], held until the next row."""

    t: float
    v: float
    w: float


@dataclass(frozen=True, slots=True)
class IncrementOdometry:
    """Motion since the previous row: ``dx``, ``dy`` [m] and ``dtheta`` [rad] in the robot's frame at the previous row."""

    t: float
    dx: float
    dy: float
    dtheta: float


@dataclass(frozen=True, slots=True)
class YawRate:
    """Turn rate ``w`` [rad/s] of a gyro, held until the next row."""

    t: float
    w: float


@dataclass(frozen=True, slots=True)
class Twist:
    """Motion in space of a robot that is carried: velocity ``v`` (3,) [m/s] and turn rate ``w`` (3,) [rad/s], both in its own
    frame, held until the next row."""

    t: float
    v: Array
    w: Array


@dataclass(frozen=True, slots=True)
class BearingRange:
    """Identified landmarks seen at one time.

    ``landmarks``: K names. ``range`` (K,) [m] and ``bearing`` (K,) [rad, in the sensor's frame]: NaN where not measured.
    """

    t: float
    landmarks: tuple[str, ...]
    range: Array
    bearing: Array


@dataclass(frozen=True, slots=True)
class RfidScan:
    """Inventory rounds of one or several antennas that ended at one time, with the R tags that were read in them.

    ``antennas``: A names of those that listened; a name may stand there twice, for two rounds. A tag of the map that none of the
    rows names was not read by an antenna that listened. ``antenna`` (R,): which of ``antennas`` read the row; ``tags``: R EPCs, one
    of them as often as it was read; ``age`` (R,) [s]: how long before ``t``; ``rssi`` (R,) [dBm], ``phase`` (R,) [rad] as the
    reader reports it, and ``frequency`` (R,) [Hz] of the carrier: NaN where unknown.
    """

    t: float
    antennas: tuple[str, ...]
    antenna: NDArray[np.int64]
    tags: tuple[str, ...]
    age: Array
    rssi: Array
    phase: Array
    frequency: Array


@dataclass(frozen=True, slots=True)
class PixelSightings:
    """Identified points seen in one image: ``points``: K names; ``pixels`` (K, 2) [px], x right, y down; ``right``: by the second
    camera of a stereo pair."""

    t: float
    points: tuple[str, ...]
    pixels: Array
    right: bool = False


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """The features of one image, none where it could not be read.

    ``pixels`` (K, 2) [px], x right, y down, (0, 0) at the centre of the upper left one; ``sizes`` (K,) [px] and ``descriptors``
    (K, D), of the kind ``feature``. ``tracks`` (K,): numbers that stay with what is followed from image to image.
    """

    t: float
    feature: str
    pixels: Array
    sizes: Array
    descriptors: NDArray[Any]
    tracks: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Tick:
    """No measurement: time has passed, and the trajectory is wanted at this stamp."""

    t: float


Odometry = VelocityOdometry | IncrementOdometry | YawRate | Twist
Exteroceptive = BearingRange | RfidScan | PixelSightings | CameraFrame  # what tells of the world around the robot
Measurement = Odometry | Exteroceptive | Tick

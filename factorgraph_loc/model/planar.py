"""Projects three-dimensional poses onto the floor, and defines settings for the axes of files and sensors."""

import math
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from factorgraph_loc.errors import InputError, require
from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.files.row_rules import Fault, require_none
from factorgraph_loc.text import Notice, notice
from factors.se2 import Array, Integers

RISE, MOST = 0.3, 3.0  # m between the lowest and the highest pose: limits for a warning and for an error
TILT = math.radians(10.0)  # angle between the z axes of the robot and the world: limit for a warning
NEGLIGIBLE = 1e-9  # component of a unit vector below which an axis does not contribute
UNIT = 0.01  # tolerance of the norm of a quaternion
# a variance marks a null pose if it is at least HUGE [m^2] and at least ABOVE_USUAL times that of the last valid pose
HUGE, ABOVE_USUAL = 1000.0, 100.0
PLACEHOLDER = 1e300  # m^2; stands for an infinite variance
NAMED = {"body": "x y z", "optical": "z -x -y"}  # axes that point forward, left and up, by name

Angle = Annotated[float, Field(ge=-2.0 * math.pi, le=2.0 * math.pi), InUnit("rad")]


def _matrix(text: str) -> Array:
    """Return the axes in ``text``, such as "z -x -y", as rows of a matrix. It is (3, 3) if there are three axes."""
    signs = NAMED.get(text, text).split()
    return np.array(
        [[(1.0 - 2.0 * s.startswith("-")) * (s.removeprefix("-") == axis) for axis in "xyz"] for s in signs]
    )


def _axes(text: str) -> str:
    rows = _matrix(text)
    if rows.shape != (3, 3) or round(float(np.linalg.det(rows))) != 1:
        raise ValueError(
            f"expected {', '.join(NAMED)}, or the three axes that point forward, left and up, right-handed, such as 'z -x -y'"
        )
    return text


Axes = Annotated[str, AfterValidator(_axes)]


class Mounting(FileModel):
    """Orientation of a sensor on the robot: rotations [rad] ``roll`` about x, then ``pitch`` about y, then ``yaw``
    about z."""

    roll: Angle = 0.0
    """rotation about the x axis"""
    pitch: Angle = 0.0
    """rotation about the y axis; down is positive"""
    yaw: Angle = 0.0
    """rotation about the z axis; left is positive"""

    def rotation(self) -> Array:
        """Return the rotation matrix (3, 3) from the sensor frame to the robot frame."""
        (cr, cp, cy), (sr, sp, sy) = (f((self.roll, self.pitch, self.yaw)) for f in (np.cos, np.sin))
        return np.array(
            [
                [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                [-sp, cp * sr, cp * cr],
            ]
        )


class Turned(FileModel):
    """The orientation of recorded poses or measurements. ``axes``: the recorded axes that point forward, left and up,
    such as "z -x -y". None means "x y z". ``mounting``: the orientation on the robot of the frame that these directions
    define."""

    axes: Axes | None = None
    """recorded axes that point forward, left and up: body (x, y, z), optical (z, -x, -y), or such a list"""
    mounting: Mounting = Mounting()
    """orientation of the measured frame on the robot"""

    def is_given(self) -> bool:
        """Return True if axes or mounting are set."""
        return self.axes is not None or self.mounting != Mounting()

    def standing(self) -> Array:
        """Return the rotation (3, 3) from the recorded axes to axes that point forward, left and up."""
        return _matrix(self.axes or "body")

    def turned(self) -> Array:
        """Return the rotation (3, 3) from the recorded axes to the robot frame."""
        return self.mounting.rotation() @ self.standing()


AS_IT_IS = Turned()


def not_unit(quaternions: Array) -> Fault:
    """Return the data of an error message about ``quaternions`` (N, 4) that do not have the length 1, as a
    :class:`Fault`. Its mask (N,) marks these quaternions. If the mask is False everywhere, there is no error."""
    with np.errstate(over="ignore"):
        length = np.sqrt(np.sum(quaternions**2, axis=1))
    return Fault("length of the quaternion", length, ~(np.abs(length - 1.0) <= UNIT), "1, a unit quaternion")


def are_null(quaternions: Array, variances: Array | None = None) -> NDArray[np.bool_]:
    """Return a mask (N,) of null poses, which some programs publish while they do not know the pose.

    ``quaternions`` (N, 4): a pose with a zero quaternion is null, unless more than half of all quaternions are zero.
    ``variances`` (N, 2) [m^2] of x and y, or None. A pose is also null if one of them is at least :data:`HUGE`, and far
    above that of the last valid pose.
    """
    null = np.asarray(~quaternions.any(axis=1))
    if 2 * np.count_nonzero(null) > len(null):
        null = np.zeros(len(null), dtype=bool)
    if variances is None:
        return null
    finite = np.nan_to_num(variances, nan=0.0, posinf=PLACEHOLDER)
    return np.asarray(null | _rise(finite[:, 0], null) | _rise(finite[:, 1], null))


def _rise(variances: Array, null: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask (N,) of the ``variances`` (N,) [m^2] that are at least :data:`HUGE` and far above the last valid
    variance. A valid variance is neither masked nor in ``null`` (N,). The first variance is not masked."""
    out = np.zeros(len(variances), dtype=bool)
    if not (variances >= HUGE).any():
        return out
    last = math.inf
    for i, variance in enumerate(variances.tolist()):
        out[i] = variance >= max(HUGE, ABOVE_USUAL * last)
        if not (out[i] or null[i]):
            last = variance
    return out


def null_poses(source: object, row: int, count: int) -> Notice:
    """Return a warning about null poses in the file ``source``. ``count``: their number. ``row``: number of the first
    row."""
    sentence = (
        "{source}:{row}: the pose is null, the first of {poses} null poses: they are skipped, and the motion is unknown "
        "until the next valid pose"
    )
    return notice("null_poses", sentence, source, row, count)


def rotations_of(source: str | Path, rows: Integers, quaternions: Array) -> Array:
    """Return the rotation matrices (N, 3, 3) of ``quaternions`` (N, 4), in the order x, y, z, w.

    ``source``: the file, ``rows`` (N,): the row numbers, for errors. Raises InputError if a length of a quaternion is
    not 1.
    """
    require_none(source, rows, [not_unit(quaternions)])
    x, y, z, w = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    matrix = [  # computed here, because importing scipy is slow
        [w * w + x * x - y * y - z * z, 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), w * w - x * x + y * y - z * z, 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), w * w - x * x - y * y + z * z],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(matrix), 2, 0))


def on_floor(
    source: object, positions: Array, rotations: Array | None, warnings: list[Notice], turned: Turned = AS_IT_IS
) -> Array:
    """Return planar poses (N, 3): x, y [m] and heading [rad], the horizontal direction of the x axis.

    ``positions`` (N, 3) [m], ``rotations`` (N, 3, 3): the recorded poses. If ``rotations`` is None, headings are 0.
    ``turned``: the axes of the recorded poses, and how their frame is mounted on the robot. A warning about the file
    ``source`` is appended to ``warnings`` if heights or tilts are too large. Raises InputError if heights differ by
    more than :data:`MOST` and no axes are set, because y and z may be swapped.
    """
    places = positions @ turned.standing().T
    poses = np.column_stack((places[:, :2], np.zeros(len(places))))
    tilt = 0.0
    if rotations is not None and len(rotations):
        stand = turned.standing()
        rotations = stand @ rotations @ stand.T @ turned.mounting.rotation().T
        poses[:, 2] = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
        tilt = float(np.arccos(np.clip(rotations[:, 2, 2], -1.0, 1.0)).max())
    rise = float(np.ptp(places[:, 2])) if len(places) else 0.0
    if rise > MOST and turned.axes is None:
        raise InputError(
            f"{source}: the height of poses varies by {rise:.1f} m, expected a robot on a floor (at most {MOST:g} m); set axes "
            'to the axes that point forward, left and up, or to "body" if these are x, y and z'
        )
    problems = ["vary in height by {rise:.2f} m"] if rise > RISE else []
    problems += ["tilt by up to {tilt:.0f} degrees"] if tilt > TILT else []
    if problems:
        sentence = f"{{source}}: poses {' and '.join(problems)}, which is ignored; check axes and mounting"
        warnings.append(
            Notice("not_planar", sentence, {"source": str(source), "rise": rise, "tilt": math.degrees(tilt)})
        )
    return poses


def about_z(source: object, rows: Integers, rates: Array, turned: Array) -> Array:
    """Return turn rates (N,) [rad/s] about the robot's z axis. ``rates`` (N, 3): about the axes of a sensor.

    ``turned`` (3, 3): the rotation from the sensor frame to the robot frame. ``source``, ``rows`` (N,): the file and
    the row numbers, for errors. Raises InputError if a rate is not finite, unless its axis is perpendicular to z.
    """
    needed = np.flatnonzero(np.abs(turned[2]) > NEGLIGIBLE)
    for i in needed.tolist():
        valid = np.isfinite(rates[:, i])
        require(valid, source, rows, f"turn rate about {'xyz'[i]}", rates[:, i], "a finite number")
    return np.asarray(rates[:, needed] @ turned[2, needed])

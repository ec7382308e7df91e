"""The poses of antennas in the frame of the tags, in compiled code.

Either the antennas are on the robot and the tags in the map, or the antennas are fixed in the building and the tags are on the
robot. The likelihood of reads depends on the pose of each antenna in the frame of the tags. That frame is the world frame in the
first case, and the robot frame in the second. Everything else is equal in both cases.
"""

import math

from factors.compiled import compiled
from factors.rfid.model import Packed
from factors.se2 import Array, Integers

ANYWHERE = 1e9  # m; a distance that contains all tags, because tags on the robot are always near it


@compiled(inline="always")
def placed(packed: Packed, antenna: int, pose: Array, offset: Array) -> tuple[float, float, float, float]:
    """Return x, y, and the cosine and sine of the heading of one ``antenna`` (an index) in the frame of the tags: the
    world, or the robot if the tags are on it. The robot is at ``offset`` (3,) in the frame of ``pose`` (3,)."""
    c0, s0 = math.cos(pose[2]), math.sin(pose[2])
    x, y = pose[0] + c0 * offset[0] - s0 * offset[1], pose[1] + s0 * offset[0] + c0 * offset[1]
    c, s = math.cos(pose[2] + offset[2]), math.sin(pose[2] + offset[2])
    a = packed.antennas[antenna]
    if packed.fixed:
        x, y = a[0] - x, a[1] - y
        return c * x + s * y, c * y - s * x, c * a[3] + s * a[4], c * a[4] - s * a[3]
    x, y = x + c * a[0] - s * a[1], y + s * a[0] + c * a[1]
    return x, y, c * a[3] - s * a[4], s * a[3] + c * a[4]


@compiled
def reach_of(packed: Packed, offsets: Array) -> float:
    """Return the largest distance [m] from the reference pose at which a tag can be read. It is :data:`ANYWHERE` for
    fixed antennas. ``offsets`` (K, 3): the robot's poses at the measurements, in the frame of the reference pose."""
    if packed.fixed:
        return ANYWHERE
    offset = farthest = 0.0
    for k in range(len(offsets)):
        offset = max(offset, math.hypot(offsets[k, 0], offsets[k, 1]))
    for a in range(len(packed.which)):
        lever = math.hypot(packed.antennas[a, 0], packed.antennas[a, 1])
        farthest = max(farthest, packed.reach[packed.which[a]] + lever)
    return offset + farthest


@compiled(inline="always")
def place_measurements(packed: Packed, pose: Array, offsets: Array, antennas: Integers, out: Array) -> float:
    """Write the antenna of each of K measurements into ``out`` (K, 8): position and boresight in the frame of the tags
    (the world, or the robot if the tags are on it), then boresight and position in the frame of ``pose`` (3,).
    ``packed``: the models. ``offsets`` (K, 3), ``antennas`` (K,): robot pose in the frame of ``pose``, and antenna.
    Returns the largest distance [m] of a readable tag."""
    farthest = 0.0
    for k in range(len(antennas)):
        a = packed.antennas[antennas[k]]
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = placed(packed, antennas[k], pose, offsets[k])
        if packed.fixed:
            c, s = math.cos(pose[2]), math.sin(pose[2])
            out[k, 4], out[k, 5] = c * a[3] + s * a[4], c * a[4] - s * a[3]
            out[k, 6] = c * (a[0] - pose[0]) + s * (a[1] - pose[1])
            out[k, 7] = c * (a[1] - pose[1]) - s * (a[0] - pose[0])
            farthest = ANYWHERE
            continue
        co, so = math.cos(offsets[k, 2]), math.sin(offsets[k, 2])
        out[k, 4], out[k, 5] = co * a[3] - so * a[4], so * a[3] + co * a[4]
        out[k, 6], out[k, 7] = offsets[k, 0] + co * a[0] - so * a[1], offsets[k, 1] + so * a[0] + co * a[1]
        reach = packed.reach[packed.which[antennas[k]]]
        farthest = max(farthest, math.sqrt(out[k, 6] ** 2 + out[k, 7] ** 2) + reach)
    return farthest

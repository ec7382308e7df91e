"""Ray casting in a building of vertical faces, and the colours at the hit points.

For a camera position, each of :data:`BINS` horizontal directions has a list of the faces that a ray may hit, nearest first. A
texture has several mip levels, each with half the resolution of the previous one. A texture on an oblique surface is sampled at
several places along the slant, in the mip level with texels about as far apart as these places.

Functions that are called for each ray are inlined. Otherwise numba's reference counting of arrays would double the run time.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.se2 import Array

BINS = 2048  # horizontal directions
LEVELS = 7  # mip levels of a texture, including the original
TAPS = 4  # largest number of texture samples on an oblique surface
STEEPEST = 1e3  # largest ratio of length to width of a pixel's footprint on an oblique surface
SLACK = 1e-9  # m: overlap of adjacent faces
NEAREST = 1e-3  # m: a face is invisible if the camera is nearer to its plane

# columns of a table of faces relative to a camera:
# NX, NY, AWAY: unit normal of the face, and the camera's distance from its plane (negative behind it)
# AX, AY, FOOT, LENGTH: unit vector along the face, coordinate of the camera along it, length of the face
# BOTTOM, TOP: heights. DISTANCE: horizontal distance of the nearest point. FACE: index in the scene
# PER_LENGTH, PER_HEIGHT: inverses of the length, and of the difference of the heights
NX, NY, AWAY, AX, AY, FOOT, LENGTH, BOTTOM, TOP, DISTANCE, FACE, PER_LENGTH, PER_HEIGHT = range(13)
GROUND, CEILING, NOTHING = -1, -2, -3  # values for a ray that hits no face, in place of a row of the table

Ints = NDArray[np.int64]
# position of a camera (x, y, z), height of the building, inverses of its width and depth
Place = tuple[float, float, float, float, float, float]


class Surroundings(NamedTuple):
    """The M faces of a building that are visible from a camera position, prepared for ray casting.

    ``origin`` (3,) [m]: the camera position. ``table`` (M, 13): the faces, sorted by distance; its columns are the
    constants of this module. Horizontal directions are divided into BINS bins. ``starts`` (BINS + 1,), ``items``: a ray
    in the bin b can hit only the rows of the table in ``items[starts[b] : starts[b + 1]]``. ``size`` (5,): width,
    depth, height, inverse width and inverse depth of the building.
    """

    origin: Array
    table: Array
    starts: Ints
    items: Ints
    size: Array


@compiled(error_model="numpy")
def surroundings(faces: Array, bottoms: Array, tops: Array, origin: Array, size: Array) -> Surroundings:
    """Return the faces that are visible from the camera position ``origin`` (3,) [m], prepared for ray casting.

    ``faces`` (F, 4): all faces of the building as segments (x1, y1, x2, y2) [m]. ``bottoms``, ``tops`` (F,) [m]: their
    heights. ``size`` (5,): width, depth, height [m], inverse width and inverse depth [1/m] of the building.
    """
    table = np.empty((len(faces), 13))
    lows, highs = np.empty(len(faces)), np.empty(len(faces))
    m = 0
    for i in range(len(faces)):
        x1, y1 = faces[i, 0] - origin[0], faces[i, 1] - origin[1]
        x2, y2 = faces[i, 2] - origin[0], faces[i, 3] - origin[1]
        length = math.hypot(x2 - x1, y2 - y1)
        ax, ay = (x2 - x1) / length, (y2 - y1) / length
        away = -(x1 * -ay + y1 * ax)
        if away < NEAREST:
            continue
        foot = -(x1 * ax + y1 * ay)
        beyond = max(-foot, foot - length, 0.0)
        row = table[m]
        row[NX], row[NY], row[AWAY], row[AX], row[AY], row[FOOT], row[LENGTH] = -ay, ax, away, ax, ay, foot, length
        row[BOTTOM], row[TOP], row[DISTANCE], row[FACE] = bottoms[i], tops[i], math.hypot(away, beyond), i
        row[PER_LENGTH], row[PER_HEIGHT] = 1.0 / length, 1.0 / (tops[i] - bottoms[i])
        right, left = _direction(x1, y1), _direction(x2, y2)
        lows[m] = right - 1e-9
        highs[m] = left + 1e-9 + (BINS if left < right else 0.0)
        m += 1
    order = np.empty(m, dtype=np.int64)
    for k in range(m):
        free = k
        while free > 0 and table[order[free - 1], DISTANCE] > table[k, DISTANCE]:
            order[free] = order[free - 1]
            free -= 1
        order[free] = k
    starts = np.zeros(BINS + 1, dtype=np.int64)
    for j in order:
        for b in range(math.floor(lows[j]), math.floor(highs[j]) + 1):
            starts[b % BINS + 1] += 1
    for b in range(BINS):
        starts[b + 1] += starts[b]
    items, used, ordered = np.empty(starts[BINS], dtype=np.int64), starts.copy(), np.empty((m, 13))
    for k in range(m):
        j = order[k]
        for c in range(13):
            ordered[k, c] = table[j, c]
        for b in range(math.floor(lows[j]), math.floor(highs[j]) + 1):
            items[used[b % BINS]] = k
            used[b % BINS] += 1
    return Surroundings(origin, ordered, starts, items, size)


@compiled(inline="always", error_model="numpy")
def cast(table: Array, starts: Ints, items: Ints, place: Place, dx: float, dy: float, dz: float) -> tuple[int, float]:
    """Return the index of the face that the ray along (dx, dy, dz) hits first, and the distance of the hit point.

    The index is a row of ``table``, or :data:`GROUND`, :data:`CEILING` or :data:`NOTHING`. The unit of the distance is
    the length of (dx, dy, dz). ``table``: the faces. ``starts``, ``items``: the index of faces by direction, fields of
    :class:`Surroundings`. ``place``: the camera position and the size of the building.
    """
    best, row = np.inf, NOTHING
    x0, y0, z0, top, per_width, per_depth = place
    if dz < -1e-12:
        best, row = -z0 / dz, GROUND
    elif dz > 1e-12:
        best, row = (top - z0) / dz, CEILING
    flat = math.sqrt(dx * dx + dy * dy)
    b = int(_direction(dx, dy)) & (BINS - 1)
    for k in range(starts[b], starts[b + 1]):
        i = items[k]
        if table[i, DISTANCE] > best * flat:
            break
        towards = table[i, NX] * dx + table[i, NY] * dy
        if towards >= 0.0:
            continue
        t = -table[i, AWAY] / towards
        s = table[i, FOOT] + t * (table[i, AX] * dx + table[i, AY] * dy)
        if s < -SLACK or s > table[i, LENGTH] + SLACK:
            continue
        z = z0 + t * dz
        if z > table[i, TOP] + SLACK or z < table[i, BOTTOM] - SLACK:
            continue
        if t < best:
            best, row = t, i
    if CEILING <= row < 0:
        # a ray from a camera outside of the building may miss floor and ceiling
        x, y = (x0 + best * dx) * per_width, (y0 + best * dy) * per_depth
        if not (-SLACK <= x <= 1.0 + SLACK and -SLACK <= y <= 1.0 + SLACK):
            best, row = np.inf, NOTHING
    return row, best


@compiled(error_model="numpy")
def cast_all(around: Surroundings, rays: Array) -> Array:
    """Return the distances (K,) to the first face that each of ``rays`` (K, 3) hits. The unit of a distance is the
    length of the ray's vector. It is infinite without a hit."""
    distance = np.empty(len(rays))
    table, starts, items = around.table, around.starts, around.items
    origin, size = around.origin, around.size
    place = (origin[0], origin[1], origin[2], size[2], size[3], size[4])
    for i in range(len(rays)):
        _, distance[i] = cast(table, starts, items, place, rays[i, 0], rays[i, 1], rays[i, 2])
    return distance


@compiled(error_model="numpy")
def expose(
    around: Surroundings,
    texels: NDArray[np.uint8],
    layout: Ints,
    directions: Array,
    rotation: Array,
    pixel_at_one: float,
    rows: NDArray[np.int16],
    out: NDArray[np.float32],
) -> None:
    """Render an image of the building, and add it to ``out`` (H, W, 3). At edges of faces, a pixel is the mean of four
    rays.

    ``around``: the faces that are visible from the camera. ``texels`` (T, 3), ``layout``: the textures, fields of
    :class:`~factorgraph_loc.simulation.renderer.TexturedScene`. ``directions`` (H, W, 2): x and y of each pixel's ray
    at depth 1 in the camera frame. ``rotation`` (3, 3): from camera to world. ``pixel_at_one``: the size of a pixel at
    a depth of 1 m, in texels. ``rows`` (H, W): work array.
    """
    height, width = directions.shape[:2]
    table, starts, items = around.table, around.starts, around.items
    origin, size = around.origin, around.size
    place = (origin[0], origin[1], origin[2], size[2], size[3], size[4])
    for edges in range(
        2
    ):  # first all pixels, then edges; one loop for both, because inlined code takes seconds to compile
        for i in range(height):
            for j in range(width):
                across, along, first = 0.0, 0.0, 4
                if edges == 1:  # remove the central ray and add four around it
                    row, first = rows[i, j], 0
                    left, right, up, down = max(j - 1, 0), min(j + 1, width - 1), max(i - 1, 0), min(i + 1, height - 1)
                    if rows[i, left] == row == rows[i, right] and rows[up, j] == row == rows[down, j]:
                        continue
                    across = (directions[i, right, 0] - directions[i, left, 0]) / (right - left)
                    along = (directions[down, j, 1] - directions[up, j, 1]) / (down - up)
                for k in range(first, 5):
                    a, b = (0.5 * (k % 2) - 0.25, 0.5 * (k // 2) - 0.25) if k < 4 else (0.0, 0.0)
                    weight = np.float32(0.25 if k < 4 else 1.0 - 2.0 * edges)
                    x, y = directions[i, j, 0] + a * across, directions[i, j, 1] + b * along
                    hit, blue, green, red = _shade(
                        table, starts, items, place, texels, layout, x, y, rotation, pixel_at_one
                    )
                    if edges == 0:
                        rows[i, j] = hit
                    out[i, j, 0] += weight * blue
                    out[i, j, 1] += weight * green
                    out[i, j, 2] += weight * red


@compiled(inline="always", error_model="numpy")
def _shade(
    table: Array,
    starts: Ints,
    items: Ints,
    place: Place,
    texels: NDArray[np.uint8],
    layout: Ints,
    x: float,
    y: float,
    rotation: Array,
    pixel_at_one: float,
) -> tuple[int, np.float32, np.float32, np.float32]:
    """Return the index of the face that the ray (x, y, 1) in the camera frame hits, and the BGR colour there.

    ``table``, ``starts``, ``items``, ``place``: the faces and the camera, see :func:`cast`. ``texels``, ``layout``: the
    textures. ``rotation`` (3, 3): from camera to world. ``pixel_at_one``: the size of a pixel at a depth of 1 m, in
    texels.
    """
    x0, y0, z0, _, per_width, per_depth = place
    dx = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]
    dy = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]
    dz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]
    row, depth = cast(table, starts, items, place, dx, dy, dz)
    blue = green = red = np.float32(0.0)
    if row == NOTHING:
        return row, blue, green, red
    flat = math.sqrt(dx * dx + dy * dy)
    along_x, along_y = 1.0, 0.0  # direction of the slant on the texture
    if row >= 0:
        number = int(table[row, FACE])
        s = table[row, FOOT] + depth * (table[row, AX] * dx + table[row, AY] * dy)
        u = 1.0 - s * table[row, PER_LENGTH]
        v = (table[row, TOP] - z0 - depth * dz) * table[row, PER_HEIGHT]
        slant = flat / abs(table[row, NX] * dx + table[row, NY] * dy)
    else:
        number = layout.shape[0] - (2 if row == GROUND else 1)
        u = (x0 + depth * dx) * per_width
        v = (y0 + depth * dy) * per_depth
        slant = math.sqrt(flat * flat + dz * dz) / abs(dz)
        along_x, along_y = dx / flat, dy / flat
    slant = min(slant, STEEPEST)
    pixel = depth * pixel_at_one  # size of a pixel at this depth, in texels, perpendicular to the slant
    taps = 1
    if slant * pixel > 1.0 and slant >= 1.5:
        taps = min(int(slant + 0.5), TAPS)
    step = slant * pixel / taps
    size, level = max(step, pixel), 0
    while size > 1.41 and level < LEVELS - 1:
        size *= 0.5
        level += 1
    first, width, height = layout[number, level, 0], layout[number, level, 1], layout[number, level, 2]
    shrunk = step / (1 << level)
    column, line = u * width, v * height
    for k in range(taps):
        offset = (k - 0.5 * (taps - 1)) * shrunk
        b, g, r = _sample(texels, first, column + offset * along_x, line + offset * along_y, width, height)
        blue, green, red = blue + b, green + g, red + r
    share = np.float32(1.0) / np.float32(taps)
    return row, share * blue, share * green, share * red


@compiled(inline="always", error_model="numpy")
def _sample(
    texels: NDArray[np.uint8], first: int, x: float, y: float, width: int, height: int
) -> tuple[np.float32, np.float32, np.float32]:
    """Return blue, green and red of a texture at ``x``, ``y`` texels from its upper left corner, interpolated.

    ``first``: the index of its first texel in ``texels``. ``width``, ``height``: its size in texels.
    """
    x = min(max(x - 0.5, 0.0), width - 1.0)
    y = min(max(y - 0.5, 0.0), height - 1.0)
    i, j = int(y), int(x)
    a, b = np.float32(y - i), np.float32(x - j)
    p = first + i * width + j
    q = p + (width if i + 1 < height else 0)
    right = 1 if j + 1 < width else 0
    unit = np.float32(1.0)
    w00, w01, w10, w11 = (unit - a) * (unit - b), (unit - a) * b, a * (unit - b), a * b
    blue = w00 * np.float32(texels[p, 0]) + w01 * np.float32(texels[p + right, 0])
    blue += w10 * np.float32(texels[q, 0]) + w11 * np.float32(texels[q + right, 0])
    green = w00 * np.float32(texels[p, 1]) + w01 * np.float32(texels[p + right, 1])
    green += w10 * np.float32(texels[q, 1]) + w11 * np.float32(texels[q + right, 1])
    red = w00 * np.float32(texels[p, 2]) + w01 * np.float32(texels[p + right, 2])
    red += w10 * np.float32(texels[q, 2]) + w11 * np.float32(texels[q + right, 2])
    return blue, green, red


@compiled(error_model="numpy")
def _direction(x: float, y: float) -> float:
    """Return the horizontal direction of (x, y) as a number in [0, BINS) that grows counter-clockwise. It is not
    proportional to the angle, because that would need a trigonometric function."""
    total = abs(x) + abs(y)
    if total == 0.0:
        return 0.0
    share = y / total
    return (BINS / 4.0) * ((1.0 + share) if x >= 0.0 else (3.0 - share))


@compiled(error_model="numpy")
def develop(
    light: NDArray[np.float32],
    gain: NDArray[np.float32],
    noise: NDArray[np.uint16],
    quantiles: NDArray[np.float32],
    read: float,
    shot: float,
) -> NDArray[np.uint8]:
    """Return the 8-bit image (H, W, 3) of a camera sensor, with noise.

    ``light`` (H, W, 3): the rendered colours. ``gain`` (H, W): the factor of each pixel. A pixel of value v after this
    gain has noise of the variance read^2 + shot * v. ``noise`` (H, W, 3): random integers that select from
    ``quantiles`` (Q,), which are quantiles of a distribution with unit variance. Q is a power of two.
    """
    height, width = gain.shape
    out = np.empty((height, width, 3), dtype=np.uint8)
    last = np.uint16(len(quantiles) - 1)
    for i in range(height):
        for j in range(width):
            for c in range(3):
                value = light[i, j, c] * gain[i, j]
                value += math.sqrt(read * read + shot * value) * quantiles[noise[i, j, c] & last]
                out[i, j, c] = int(min(max(value + 0.5, 0.0), 255.0))
    return out

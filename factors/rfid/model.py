"""The detection model of RFID antennas: the probability that an inventory round of an antenna reads a tag.

An inventory round is one attempt of a reader to read all tags in range. A model gives the logit of the read probability as a
function of the tag's position in the antenna's frame (x along the boresight, y to the left, z up) and of the tag's facing. The
final probability is ``q = false_read + (1 - false_read - miss) * sigmoid(logit)``. The floor ``false_read`` allows reads from
anywhere, such as reflections, which makes the likelihood robust. The likelihood is in :mod:`factors.rfid.kernels`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.rfid.knots import cubic_weights
from factors.se2 import Array

BEAM, LOGISTIC, GRID = 0, 1, 2
FEATURES = ("1", "r", "r^2", "w", "w^2", "r w", "|z|", "c", "c^2", "r c", "w c")
NEGLIGIBLE_LOGIT = -14.0  # logit of a tag out of range
NEAR = 1e-2  # m; is added in square to a squared distance, so that directions are defined at the antenna
PARAMETERS = 12  # maximum number of parameters of a detection model in compiled code
ALMOST_ONE = 1.0 - 1e-9  # maximum read probability of a beam model, because 1 has no logit
# The sigmoid in :class:`BeamModel` that reduces reads from behind a tag: its negative center and its width.
FRONT, SIDE = 0.25, 0.15


class DetectionModel(Protocol):
    """The interface of a detection model. ``reach`` [m]: the horizontal range. Beyond it all reads are false."""

    @property
    def reach(self) -> float: ...

    @property
    def uses_facing(self) -> bool:
        """True if the read probability depends on the direction of the tag's front."""

    @property
    def peak(self) -> float:
        """The largest read probability of the model."""

    def compiled(self) -> tuple[int, Sequence[float], Array]:
        """Return the model for compiled code: kind, parameters, and grid of logits (H, F, NX, NY) or an empty array."""


@dataclass(frozen=True)
class BeamModel:
    """A detection model of a beam with soft edges, the default of uncalibrated antennas.

    The read probability is ``p0 * sigmoid((r_max - r) / s_r) * exp(-(phi / sigma_phi)^2 / 2) * front``, with the
    distance r [m] and the bearing phi [rad] of the tag. ``front = behind + (1 - behind) * sigmoid((c + 0.25) / 0.15)``
    depends on the cosine c of the angle between the tag's front and the direction to the antenna (0 if unknown).
    ``r_max``, ``s_r`` [m], ``sigma_phi`` [rad]: range, width of its edge, and width of the beam. ``behind``: the read
    probability from behind a tag, divided by that from its front.
    """

    p0: float = 0.9
    r_max: float = 4.5
    s_r: float = 0.3
    sigma_phi: float = 0.698
    behind: float = 1.0

    @property
    def reach(self) -> float:
        return self.r_max + 12.0 * self.s_r

    @property
    def uses_facing(self) -> bool:
        return self.behind < 1.0

    @property
    def peak(self) -> float:
        return self.p0

    def compiled(self) -> tuple[int, Sequence[float], Array]:
        # a probability of one has no logit
        values = math.log(min(self.p0, ALMOST_ONE)), self.r_max, self.s_r, self.sigma_phi, self.behind
        return BEAM, values, np.empty((0, 0, 0, 0))


@dataclass(frozen=True)
class LogisticModel:
    """A detection model with a logit linear in :data:`FEATURES` up to the distance ``reach`` [m], with ``coefficients``
    (11,). The features depend on the horizontal distance r [m], the height difference z [m], and w = 1 - cosine of the
    bearing. They also depend on c, the cosine of the angle between the tag's front and the direction to the antenna."""

    coefficients: Sequence[float]
    reach: float = 8.0

    @property
    def uses_facing(self) -> bool:
        return any(value != 0.0 for value in self.coefficients[7:])

    @property
    def peak(self) -> float:
        return _probability(_logistic_peak(np.array(self.coefficients), self.reach))

    def compiled(self) -> tuple[int, Sequence[float], Array]:
        return LOGISTIC, tuple(self.coefficients), np.empty((0, 0, 0, 0))


@dataclass(frozen=True, eq=False)
class GridModel:
    """A detection model with a grid of logits in the antenna's frame.

    ``logits`` (H, F, NX, NY): the logits of the read probability at grid points that are ``cell`` [m] apart. The first
    point is at (``x0``, ``y0``). ``heights`` (H,) [m]: heights of the tag above the antenna, ascending and evenly
    spaced. The F facings are evenly spaced cosines from -1 to 1 of the angle between the tag's front and the direction
    to the antenna. F is 1 if this angle is irrelevant. Interpolation is linear in height, otherwise cubic. The logit is
    constant from the edge of the grid up to ``reach``.
    """

    logits: Array
    x0: float
    y0: float
    cell: float
    heights: Array

    @property
    def reach(self) -> float:
        nx, ny = self.logits.shape[2:]
        x = max(abs(self.x0), abs(self.x0 + (nx - 1) * self.cell))
        y = max(abs(self.y0), abs(self.y0 + (ny - 1) * self.cell))
        return math.hypot(x, y)

    @property
    def uses_facing(self) -> bool:
        return int(self.logits.shape[1]) > 1

    @property
    def peak(self) -> float:
        return _probability(float(np.max(self.logits)))

    def compiled(self) -> tuple[int, Sequence[float], Array]:
        step = self.heights[1] - self.heights[0] if len(self.heights) > 1 else 1.0
        return GRID, (self.x0, self.y0, self.cell, float(self.heights[0]), float(step)), self.logits


@dataclass(frozen=True)
class Antenna:
    """Position ``x``, ``y``, ``z`` [m] and boresight ``yaw``, ``pitch`` (positive is up) [rad] of an antenna in the
    robot frame. ``model``: index of its detection model."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0
    pitch: float = 0.0
    model: int = 0


class Packed(NamedTuple):
    """A :class:`RfidModel` for compiled code. ``antennas`` (A, 7): x, y, z, cosine and sine of yaw, and of pitch.
    ``which`` (A,): the index of each antenna's model. ``kinds`` (M,), ``parameters`` (M, 12), ``reach`` (M,) [m]: of M
    models. ``knots``: the logits of all grids. ``shapes`` (M, 5): H, F, NX, NY and first index in ``knots`` of a grid.
    ``scale``, ``rate`` (M,), ``delay`` (1,) [s]: see :mod:`factors.rfid.parameters`. ``peak`` (M,): largest read
    probability. ``span``: 1 - false read - miss probability. ``fixed``: True if the tags are on the robot."""

    antennas: Array
    which: NDArray[np.int64]
    kinds: NDArray[np.int64]
    parameters: Array
    shapes: NDArray[np.int64]
    knots: Array
    reach: Array
    false_read: float
    span: float
    scale: Array
    rate: Array
    peak: Array
    delay: Array
    fixed: bool


@dataclass(frozen=True)
class RfidModel:
    """All antennas and their detection models. ``false_read``: the read probability of a tag out of range. ``miss``:
    the probability of a miss where a model predicts a certain read. ``tempering``: exponent of the likelihood, below 1
    if reads are correlated. ``fixed``: True if antennas are fixed in the world, and the tags are on the robot."""

    antennas: tuple[Antenna, ...]
    models: tuple[DetectionModel, ...]
    false_read: float = 1e-3
    miss: float = 0.0
    tempering: float = 1.0
    fixed: bool = False

    def packed(self) -> Packed:
        """Return the model as a tuple of arrays for compiled code."""
        compiled = [model.compiled() for model in self.models]
        parameters = np.zeros((len(compiled), PARAMETERS))
        shapes = np.zeros((len(compiled), 5), dtype=np.int64)
        knots: list[Array] = []
        for i, (_, values, grid) in enumerate(compiled):
            parameters[i, : len(values)] = values
            shapes[i] = (*grid.shape, sum(len(k) for k in knots))
            knots.append(np.ascontiguousarray(grid, dtype=float).ravel())
        rows = [
            (a.x, a.y, a.z, math.cos(a.yaw), math.sin(a.yaw), math.cos(a.pitch), math.sin(a.pitch))
            for a in self.antennas
        ]
        return Packed(
            np.array(rows).reshape(-1, 7),
            np.array([a.model for a in self.antennas], dtype=np.int64),
            np.array([kind for kind, _, _ in compiled], dtype=np.int64),
            parameters,
            shapes,
            np.concatenate(knots) if knots else np.empty(0),
            np.array([model.reach for model in self.models]),
            self.false_read,
            1.0 - self.false_read - self.miss,
            np.ones(len(self.models)),
            np.ones(len(self.models)),
            np.array([model.peak for model in self.models]),
            np.zeros(1),
            self.fixed,
        )


def _probability(logit: float) -> float:
    return 1.0 / (1.0 + math.exp(-logit))


def logits(model: DetectionModel, points: Array, facing: Array | float = 0.0) -> tuple[Array, Array]:
    """Return the logits (N,) of read probabilities of tags at ``points`` (N, 3) [m] in the antenna's frame, and their
    gradient (N, 4) by points and ``facing`` (N,): cosines between tags' fronts and directions to the antenna."""
    packed = RfidModel((Antenna(),), (model,)).packed()
    points = np.atleast_2d(np.asarray(points, dtype=float))
    facing = np.ascontiguousarray(np.broadcast_to(np.asarray(facing, dtype=float), len(points)))
    out = np.empty((len(points), 5))
    _logits(packed.kinds[0], packed.parameters[0], packed.shapes[0], packed.knots, points, facing, out)
    return out[:, 0], out[:, 1:]


def probability(model: DetectionModel, points: Array, facing: Array | float = 0.0) -> Array:
    """Return the read probabilities (N,), without false reads, of tags at ``points`` (N, 3) [m] in the antenna's frame.
    ``facing`` (N,): the cosine of the angle between each tag's front and the direction to the antenna."""
    return np.asarray(1.0 / (1.0 + np.exp(-logits(model, points, facing)[0])))


def bake(
    model: DetectionModel, extent: float, cell: float = 0.1, heights: Sequence[float] = (0.0,), facings: int = 1
) -> GridModel:
    """Convert any detection model to a grid from -``extent`` to ``extent`` [m] in x and y. ``cell`` [m]: the spacing.
    ``heights`` [m]: tag heights above the antenna. ``facings``: the number of directions of the tag's front."""
    count = 2 * math.ceil(extent / cell) + 1
    axis = cell * (np.arange(count) - (count - 1) / 2.0)
    cosines = np.linspace(-1.0, 1.0, facings) if facings > 1 else np.zeros(1)
    h, c, x, y = np.meshgrid(np.asarray(heights, dtype=float), cosines, axis, axis, indexing="ij")
    sampled, _ = logits(model, np.stack((x, y, h), axis=-1).reshape(-1, 3), c.ravel())
    return GridModel(sampled.reshape(h.shape), float(axis[0]), float(axis[0]), cell, np.asarray(heights, dtype=float))


@compiled
def _logits(
    kind: int,
    parameters: Array,
    shape: NDArray[np.int64],
    knots: Array,
    points: Array,
    facing: Array,
    out: Array,
) -> None:
    for i in range(len(points)):
        values = logit(kind, parameters, shape, knots, points[i, 0], points[i, 1], points[i, 2], facing[i])
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = values


@compiled
def logit(
    kind: int, parameters: Array, shape: NDArray[np.int64], knots: Array, x: float, y: float, z: float, c: float
) -> tuple[float, float, float, float, float]:
    """Return the logit of the read probability at (x, y, z) in the antenna's frame, and its derivatives by x, y, z, c.
    ``c``: cosine between tag front and direction to the antenna. The rest: one model of :class:`Packed`."""
    if kind == BEAM:
        return _beam(parameters, x, y, z, c)
    if kind == LOGISTIC:
        return _logistic(parameters, x, y, z, c)
    return _grid(parameters, shape, knots, x, y, z, c)


@compiled
def _beam(parameters: Array, x: float, y: float, z: float, c: float) -> tuple[float, float, float, float, float]:
    log_p0, r_max, s_r, sigma_phi = parameters[0], parameters[1], parameters[2], parameters[3]
    r = math.sqrt(x * x + y * y + z * z + NEAR * NEAR)
    phi = math.atan2(y, x)
    excess = (r_max - r) / s_r
    # the logarithm of a sigmoid, without overflow
    log_range = -math.log1p(math.exp(-excess)) if excess > 0.0 else excess - math.log1p(math.exp(excess))
    behind = parameters[4]
    sigmoid = 1.0 / (1.0 + math.exp(-(c + FRONT) / SIDE))
    front = behind + (1.0 - behind) * sigmoid
    by_c = (1.0 - behind) * sigmoid * (1.0 - sigmoid) / SIDE / front
    log_p = log_p0 + log_range - 0.5 * (phi / sigma_phi) ** 2 + math.log(front)
    by_log_p = 1.0 / -math.expm1(log_p)
    by_r = -(1.0 - math.exp(log_range)) / s_r / r
    by_phi = -phi / sigma_phi**2 / max(x * x + y * y, NEAR * NEAR)
    value = log_p - math.log(-math.expm1(log_p))
    by_x, by_y = by_log_p * (by_r * x - by_phi * y), by_log_p * (by_r * y + by_phi * x)
    return value, by_x, by_y, by_log_p * by_r * z, by_log_p * by_c


@compiled(inline="always")
def logistic_value(b: Array, r: float, w: float, height: float, c: float) -> float:
    """Return the logit of a logistic model with coefficients ``b``. For r, w and c see :class:`LogisticModel`."""
    value = b[0] + r * (b[1] + b[2] * r) + w * (b[3] + b[4] * w + b[5] * r) + b[6] * abs(height)
    return float(value + c * (b[7] + b[8] * c + b[9] * r + b[10] * w))


@compiled
def _logistic_peak(b: Array, reach: float) -> float:
    """Return the largest logit of a logistic model with coefficients ``b`` (11,) over all bearings, tag directions, and
    ranges up to ``reach`` [m]. The tags are at the antenna's height."""
    largest = -np.inf
    for r in np.linspace(0.0, reach, 81):
        for w in np.linspace(0.0, 2.0, 9):
            for c in np.linspace(-1.0, 1.0, 9):
                largest = max(largest, logistic_value(b, r, w, 0.0, c))
    return largest


@compiled
def _logistic(b: Array, x: float, y: float, z: float, c: float) -> tuple[float, float, float, float, float]:
    r = math.sqrt(x * x + y * y + NEAR * NEAR)
    cosine = x / r
    w = 1.0 - cosine
    value = logistic_value(b, r, w, z, c)
    by_r = b[1] + 2.0 * b[2] * r + b[5] * w + b[9] * c
    by_w = b[3] + 2.0 * b[4] * w + b[5] * r + b[10] * c
    by_c = b[7] + 2.0 * b[8] * c + b[9] * r + b[10] * w
    by_x = by_r * cosine - by_w * (1.0 - cosine * cosine) / r
    by_y = by_r * y / r + by_w * cosine * y / (r * r)
    return value, by_x, by_y, b[6] if z > 0.0 else -b[6], by_c


@compiled
def _slope(f: float) -> tuple[float, float, float, float]:
    """Return the derivatives of :func:`cubic_weights` by ``f``."""
    return (
        (-1.5 * f + 2.0) * f - 0.5,
        (4.5 * f - 5.0) * f,
        (-4.5 * f + 4.0) * f + 0.5,
        (1.5 * f - 1.0) * f,
    )


@compiled
def _place(s: float, count: int) -> tuple[int, float, float]:
    """Clip a coordinate ``s`` to a row of ``count`` grid points 0, 1, .... Returns the grid point below, the fractional
    part, and 1 if ``s`` was inside, otherwise 0."""
    if count == 1 or s <= 0.0:
        return 0, 0.0, 0.0
    if s >= count - 1:
        return count - 2, 1.0, 0.0
    i = min(int(s), count - 2)
    return i, s - i, 1.0


@compiled
def _grid(
    parameters: Array, shape: NDArray[np.int64], knots: Array, x: float, y: float, z: float, c: float
) -> tuple[float, float, float, float, float]:
    x0, y0, cell, z0, dz = parameters[0], parameters[1], parameters[2], parameters[3], parameters[4]
    nh, nf, nx, ny, first = shape[0], shape[1], shape[2], shape[3], shape[4]
    i, fx, in_x = _place((x - x0) / cell, nx)
    j, fy, in_y = _place((y - y0) / cell, ny)
    k, fc, in_c = _place((c + 1.0) / 2.0 * (nf - 1), nf)
    m, fz, in_z = _place((z - z0) / dz, nh)
    wx, wy, wc = cubic_weights(fx), cubic_weights(fy), cubic_weights(fc)
    dx, dy, dc = _slope(fx), _slope(fy), _slope(fc)
    value = by_x = by_y = by_z = by_c = 0.0
    for a in range(2 if nh > 1 else 1):
        w_z = 1.0
        d_z = 0.0
        if nh > 1:
            w_z, d_z = (1.0 - fz, -1.0) if a == 0 else (fz, 1.0)
        for b in range(4 if nf > 1 else 1):
            w_c, d_c = (wc[b], dc[b]) if nf > 1 else (1.0, 0.0)
            layer = min(max(k + b - 1, 0), nf - 1) if nf > 1 else 0
            plane = first + ((m + a) * nf + layer) * nx * ny
            flat = by_px = by_py = 0.0
            for p in range(4):
                row = plane + min(max(i + p - 1, 0), nx - 1) * ny
                across = by_across = 0.0
                for q in range(4):
                    knot = knots[row + min(max(j + q - 1, 0), ny - 1)]
                    across += wy[q] * knot
                    by_across += dy[q] * knot
                flat += wx[p] * across
                by_px += dx[p] * across
                by_py += wx[p] * by_across
            value += w_z * w_c * flat
            by_x += w_z * w_c * by_px
            by_y += w_z * w_c * by_py
            by_c += w_z * d_c * flat
            by_z += d_z * w_c * flat
    return value, in_x * by_x / cell, in_y * by_y / cell, in_z * by_z / dz, in_c * by_c * (nf - 1) / 2.0

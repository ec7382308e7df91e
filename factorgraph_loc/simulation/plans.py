"""Floor plans: walls, furniture and shelves as segments, and the surfaces that tags are mounted on."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.simulation.settings import WorldSettings
from factors.se2 import Array

Segment = tuple[float, float, float, float]
ROOM_WIDTH = 5.0  # m, approximate
CORRIDOR_WIDTH = 2.0
DOOR_WIDTH = 1.0
SHELF_DEPTH = 1.0
AISLE_WIDTH = 3.0
HALL_WIDTH = 3.0  # m, of the corridors of the H-shaped plan
FROM_END = 2.0  # m, of a tag from the end of a corridor
LOWEST_BOX = 1.4  # m: least height of furniture and shelves


@dataclass(frozen=True)
class Plan:
    """Outline and inner walls, ``boxes`` (furniture, shelves, closed rooms) as (x1, y1, x2, y2), and ``doors``, gaps in walls,
    all in metres; ``hanging``: positions (x, y) of hanging tags, which replace tags on surfaces.
    """

    width: float
    depth: float
    walls: tuple[Segment, ...]
    boxes: tuple[Segment, ...]
    doors: tuple[Segment, ...] = ()
    hanging: tuple[tuple[float, float], ...] = ()

    def segments(self) -> Array:
        """All segments (S, 4) that block motion and sight."""
        return np.array([*self.walls, *(side for box in self.boxes for side in _sides(box))])

    def faces(self) -> tuple[Array, Array]:
        """The sides of walls and of boxes as segments (F, 4) with the free side on the left. Inner walls have two."""
        walls = [face for wall in self.walls for face in both_sides(wall) if self._is_inside(face)]
        boxes = [(x2, y2, x1, y1) for box in self.boxes for x1, y1, x2, y2 in _sides(box)]
        return np.array(walls).reshape(-1, 4), np.array(boxes).reshape(-1, 4)

    def open(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (N, 2) are inside the building and outside of all boxes."""
        x, y = points.T
        out = self.indoors(points)
        for x1, y1, x2, y2 in self.boxes:
            out &= (x < x1) | (x > x2) | (y < y1) | (y > y2)
        return np.asarray(out)

    def indoors(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (N, 2) are inside the building."""
        x, y = points.T
        return np.asarray((x > 0.0) & (x < self.width) & (y > 0.0) & (y < self.depth))

    def _is_inside(self, face: Segment) -> bool:
        """Whether the left side of a face is inside the building."""
        x1, y1, x2, y2 = face
        length = math.hypot(x2 - x1, y2 - y1)
        x, y = (x1 + x2) / 2.0 - 0.05 * (y2 - y1) / length, (y1 + y2) / 2.0 + 0.05 * (x2 - x1) / length
        return 0.0 < x < self.width and 0.0 < y < self.depth


def both_sides(segment: Segment) -> tuple[Segment, Segment]:
    """The segment and its reverse."""
    x1, y1, x2, y2 = segment
    return segment, (x2, y2, x1, y1)


def make_plan(settings: WorldSettings, rng: np.random.Generator) -> Plan:
    """Make the plan named in ``settings``, with random doors and furniture."""
    width, depth = settings.width, settings.depth
    outline = tuple(_sides((0.0, 0.0, width, depth)))
    if settings.plan == "hall":
        return Plan(width, depth, outline, ())
    if settings.plan == "warehouse":
        return Plan(width, depth, outline, _shelves(width, depth))
    if settings.plan == "corridors":
        return _corridors(width, depth, outline, rng)
    return _office(width, depth, outline, rng)


def _office(width: float, depth: float, outline: tuple[Segment, ...], rng: np.random.Generator) -> Plan:
    """Rooms on both sides of a corridor along x, each with a door to it and two pieces of furniture at its outer corners."""
    if width < 4.0 or depth < 6.0:
        raise InputError(f"world: an office of {width:g} x {depth:g} m has no rooms, expected at least 4 x 6 m")
    rooms = max(1, round(width / ROOM_WIDTH))
    low, high = (depth - CORRIDOR_WIDTH) / 2.0, (depth + CORRIDOR_WIDTH) / 2.0
    edges = np.linspace(0.0, width, rooms + 1)
    walls: list[Segment] = list(outline)
    boxes: list[Segment] = []
    doors: list[Segment] = []
    for inner, outer in ((low, 0.0), (high, depth)):
        for left, right in pairwise(edges.tolist()):
            door = float(rng.uniform(left + 0.6, right - 0.6 - DOOR_WIDTH))
            walls += [(left, inner, door, inner), (door + DOOR_WIDTH, inner, right, inner)]
            doors.append((door, inner, door + DOOR_WIDTH, inner))
            boxes += _furniture((left, right), inner, outer, rng)
        walls += [(float(x), inner, float(x), outer) for x in edges[1:-1]]
    return Plan(width, depth, tuple(walls), tuple(boxes), tuple(doors))


def _furniture(span: tuple[float, float], inner: float, outer: float, rng: np.random.Generator) -> list[Segment]:
    """A cupboard in each outer corner of a room that is large enough to drive past them."""
    left, right = span
    deep, wide = abs(inner - outer), right - left
    if deep < 3.5 or wide < 4.0:
        return []
    out = []
    for at_left in (True, False):
        across, along = rng.uniform(0.4, 0.8), rng.uniform(0.8, 1.4)
        x1, x2 = (left, left + across) if at_left else (right - across, right)
        y1, y2 = (outer, outer + along) if outer < inner else (outer - along, outer)
        out.append((float(x1), float(y1), float(x2), float(y2)))
    return out


def _shelves(width: float, depth: float) -> tuple[Segment, ...]:
    """Rows along x with aisles between them, long ones interrupted in the middle."""
    rows = max(1, math.floor((depth - AISLE_WIDTH) / (SHELF_DEPTH + AISLE_WIDTH)))
    pitch = (depth - rows * SHELF_DEPTH) / (rows + 1)
    margin = min(AISLE_WIDTH, width / 4.0)
    spans = [(margin, width - margin)]
    if width > 20.0:
        spans = [(margin, (width - AISLE_WIDTH) / 2.0), ((width + AISLE_WIDTH) / 2.0, width - margin)]
    bottoms = [pitch + i * (SHELF_DEPTH + pitch) for i in range(rows)]
    return tuple((x1, y, x2, y + SHELF_DEPTH) for y in bottoms for x1, x2 in spans)


def _corridors(width: float, depth: float, outline: tuple[Segment, ...], rng: np.random.Generator) -> Plan:
    """An H with a half-turn symmetry: a corridor along x and one across each of its ends; the rest are closed rooms.

    A tag hangs in the middle, and one in an arm at each end, in opposite arms: coming from the middle the robot finds both on
    its left or both on its right, which is random.
    """
    if width < 4.0 * HALL_WIDTH or depth < 3.0 * HALL_WIDTH:
        raise InputError(
            f"world: {width:g} x {depth:g} m is too small for corridors, expected at least "
            f"{4.0 * HALL_WIDTH:g} x {3.0 * HALL_WIDTH:g} m"
        )
    low, high = (depth - HALL_WIDTH) / 2.0, (depth + HALL_WIDTH) / 2.0
    count = max(1, round((width - 2.0 * HALL_WIDTH) / ROOM_WIDTH))
    edges = np.linspace(HALL_WIDTH, width - HALL_WIDTH, count + 1).tolist()
    rooms = [(x1, y1, x2, y2) for y1, y2 in ((0.0, low), (high, depth)) for x1, x2 in pairwise(edges)]
    middle = HALL_WIDTH / 2.0
    at = FROM_END if rng.random() < 0.5 else depth - FROM_END
    hanging = ((width / 2.0, depth / 2.0), (middle, at), (width - middle, depth - at))
    return Plan(width, depth, outline, tuple(rooms), hanging=hanging)


def _sides(box: Segment) -> list[Segment]:
    """The four sides of a box, its inside on the left."""
    x1, y1, x2, y2 = box
    return [(x1, y1, x2, y1), (x2, y1, x2, y2), (x2, y2, x1, y2), (x1, y2, x1, y1)]

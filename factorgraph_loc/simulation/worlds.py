"""Simulated worlds: floor plans of walls, furniture and shelves, and the tags, landmarks and points on them."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.measurement import Landmark
from factorgraph_loc.sensors.rfid.map import Tag
from factorgraph_loc.sensors.rfid.settings import FixedAntenna
from factorgraph_loc.simulation.settings import WorldSettings
from factors.se2 import Array

Segment = tuple[float, float, float, float]
ROOM_WIDTH = 5.0  # m, approximate
CORRIDOR_WIDTH = 2.0  # m
DOOR_WIDTH = 1.0  # m
SHELF_DEPTH = 1.0  # m
AISLE_WIDTH = 3.0  # m
HALL_WIDTH = 3.0  # m: width of the corridors of the H-shaped plan
FROM_END = 2.0  # m: distance of a hanging tag from the end of its corridor
LOWEST_BOX = 1.4  # m: least height of furniture and shelves
STANDOFF = 0.02  # m: distance of a tag or point from its surface
POINT_HEIGHTS = (0.3, 2.2)  # m: range of the heights of points on walls
IN_FRONT = 0.3  # m of free space needed before a tag
CANDIDATES = 10  # random places for each tag; the one farthest from the other tags is chosen


@dataclass(frozen=True)
class Plan:
    """The floor plan of a building. All lengths are in metres, segments and boxes are (x1, y1, x2, y2).

    ``width``, ``depth``: the size along x and y; a corner is at the origin. ``walls``: the outline and inner walls.
    ``boxes``: furniture, shelves and closed rooms. ``doors``: gaps in walls.
    ``hanging``: positions (x, y) of hanging tags. If there are any, no tags are placed on surfaces.
    """

    width: float
    depth: float
    walls: tuple[Segment, ...]
    boxes: tuple[Segment, ...]
    doors: tuple[Segment, ...] = ()
    hanging: tuple[tuple[float, float], ...] = ()

    def segments(self) -> Array:
        """Return all segments (S, 4) of walls and boxes, which block motion and sight."""
        return np.array([*self.walls, *(side for box in self.boxes for side in _sides(box))])

    def faces(self) -> tuple[Array, Array]:
        """Return the faces of walls, and the faces of boxes, as two arrays of segments (F, 4). The free side is on the
        left of a segment. An inner wall has two faces."""
        walls = np.array([face for wall in self.walls for face in both_sides(wall)]).reshape(-1, 4)
        middles = _places(walls, np.full(len(walls), 0.5))[:, :2]
        boxes = [(x2, y2, x1, y1) for box in self.boxes for x1, y1, x2, y2 in _sides(box)]
        return walls[self.indoors(middles)], np.array(boxes).reshape(-1, 4)

    def open(self, points: Array) -> NDArray[np.bool_]:
        """Return a mask (N,) of the ``points`` (N, 2) that are inside the building and outside of all boxes."""
        x, y = points.T
        out = self.indoors(points)
        for x1, y1, x2, y2 in self.boxes:
            out &= (x < x1) | (x > x2) | (y < y1) | (y > y2)
        return np.asarray(out)

    def indoors(self, points: Array) -> NDArray[np.bool_]:
        """Return a mask (N,) of the ``points`` (N, 2) that are inside the outline of the building."""
        x, y = points.T
        return np.asarray((x > 0.0) & (x < self.width) & (y > 0.0) & (y < self.depth))


def both_sides(segment: Segment) -> tuple[Segment, Segment]:
    """Return the segment (x1, y1, x2, y2) and the reversed segment (x2, y2, x1, y1)."""
    x1, y1, x2, y2 = segment
    return segment, (x2, y2, x1, y1)


def make_plan(settings: WorldSettings, rng: np.random.Generator) -> Plan:
    """Return a floor plan of the kind named in ``settings``, with random doors and furniture."""
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
    """Return the plan of an office in ``outline``: rooms on both sides of a corridor along x. Each room has a door to
    the corridor and, if it is large enough, furniture in its two outer corners."""
    if width < 4.0 or depth < 6.0:
        raise InputError(f"world: width and depth are {width:g} and {depth:g} m, an office needs at least 4 and 6 m")
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
    """Return a cupboard for each outer corner of a room, as boxes, or nothing if the robot could not drive past.

    ``span``: the x range of the room. ``inner``, ``outer``: the y coordinates of its walls at the corridor and at the
    outline.
    """
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
    """Return rows of shelves along x as boxes (x1, y1, x2, y2), with aisles between them. Long rows have a gap in the
    middle."""
    rows = max(1, math.floor((depth - AISLE_WIDTH) / (SHELF_DEPTH + AISLE_WIDTH)))
    pitch = (depth - rows * SHELF_DEPTH) / (rows + 1)
    margin = min(AISLE_WIDTH, width / 4.0)
    spans = [(margin, width - margin)]
    if width > 20.0:
        spans = [(margin, (width - AISLE_WIDTH) / 2.0), ((width + AISLE_WIDTH) / 2.0, width - margin)]
    bottoms = [pitch + i * (SHELF_DEPTH + pitch) for i in range(rows)]
    return tuple((x1, y, x2, y + SHELF_DEPTH) for y in bottoms for x1, x2 in spans)


def _corridors(width: float, depth: float, outline: tuple[Segment, ...], rng: np.random.Generator) -> Plan:
    """Return an H-shaped plan with a half-turn symmetry: a corridor along x and a corridor across each of its ends.
    Closed rooms fill the rest of the building.

    One tag hangs in the middle of the H. Two more tags hang in opposite arms at its ends. As seen from the middle, both
    are on the left or both are on the right. The side is random.
    """
    if width < 4.0 * HALL_WIDTH or depth < 3.0 * HALL_WIDTH:
        raise InputError(
            f"world: width and depth are {width:g} and {depth:g} m, corridors need at least "
            f"{4.0 * HALL_WIDTH:g} and {3.0 * HALL_WIDTH:g} m"
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
    """Return the four sides of a box as segments with the inside of the box on their left."""
    x1, y1, x2, y2 = box
    return [(x1, y1, x2, y1), (x2, y1, x2, y2), (x2, y2, x1, y2), (x1, y2, x1, y1)]


def make_world(settings: WorldSettings, rng: np.random.Generator) -> World:
    """Return a map with tags ``T000``..., landmarks ``L000``... and points ``P0000``.... Boxes count as walls.

    ``settings``: kind and size of the building, and numbers of objects. A tag on a surface faces away from the surface.
    Hanging tags, and tags on the floor at height 0, have no direction. Raises InputError if the plan has too few places
    for the tags.
    """
    plan = make_plan(settings, rng)
    tags: dict[str, Tag] = {}
    walls, boxes = plan.faces()
    count = settings.tag_count()
    upright = [faces for name, faces in (("wall", walls), ("shelf", boxes)) if name in settings.surfaces]
    faces = np.concatenate(upright) if upright else np.empty((0, 4))
    if settings.surfaces == ("shelf",) and not len(faces):
        raise InputError(
            f"world: plan {settings.plan} of this size has no shelves for tags: add wall or floor to world.surfaces"
        )
    if plan.hanging and count > len(plan.hanging):
        raise InputError(f"world: tags is {count}, expected at most {len(plan.hanging)} in plan {settings.plan}")
    on_floor = 0
    if "floor" in settings.surfaces and not plan.hanging:
        on_floor = round(count / len(settings.surfaces)) if len(faces) else count
    on_faces = 0 if plan.hanging else count - on_floor
    places = _even(settings, on_faces) if settings.even else _distribute(plan, faces, on_faces, rng)
    for x, y, facing in places.tolist():
        tags[f"T{len(tags):03d}"] = Tag(x=x, y=y, z=settings.tag_height, facing=facing)
    for x, y in plan.hanging[:count]:
        tags[f"T{len(tags):03d}"] = Tag(x=x, y=y, z=settings.tag_height)
    for x, y in rng.uniform((0.2, 0.2), (plan.width - 0.2, plan.depth - 0.2), (on_floor, 2)).round(3).tolist():
        tags[f"T{len(tags):03d}"] = Tag(x=x, y=y, z=0.0)
    landmarks = _distribute(plan, walls, settings.landmarks, rng)[:, :2].tolist()
    return World(
        name=settings.plan,
        tags=tags,
        antennas=_antennas(plan, walls, settings, rng),
        landmarks={f"L{i:03d}": Landmark(x=x, y=y) for i, (x, y) in enumerate(landmarks)},
        points=_points(plan, walls, boxes, settings.points, rng) if settings.points else None,
        walls=tuple((a, b, c, d) for a, b, c, d in plan.segments().round(3).tolist()),
    )


def _antennas(plan: Plan, walls: Array, settings: WorldSettings, rng: np.random.Generator) -> dict[str, FixedAntenna]:
    """Return the fixed antennas by name, at the height of the tags. The first ones are in the middle of the doors, half
    of them facing to each side of the door. The rest are on walls."""
    doors = np.array([both_sides(door)[side] for side in (0, 1) for door in plan.doors]).reshape(-1, 4)
    at_doors = _places(doors[: settings.antennas], np.full(min(len(doors), settings.antennas), 0.5))
    places = np.concatenate((at_doors, _distribute(plan, walls, settings.antennas - len(at_doors), rng))).round(4)
    antennas = [FixedAntenna.bounded(x=x, y=y, z=settings.tag_height, yaw=yaw) for x, y, yaw in places.tolist()]
    return dict(zip(settings.antenna_names(), antennas, strict=True))


def _distribute(plan: Plan, faces: Array, count: int, rng: np.random.Generator) -> Array:
    """Return ``count`` positions distributed over ``faces`` (F, 4), as (count, 3): x, y, and the direction away from
    the face.

    For each position, :data:`CANDIDATES` positions are drawn uniformly along the faces. The one farthest from the
    previous positions is chosen (best-candidate sampling: Mitchell, SIGGRAPH 1991). Positions behind furniture are not
    chosen.
    """
    out = np.empty((count, 3))
    length = np.hypot(faces[:, 2] - faces[:, 0], faces[:, 3] - faces[:, 1])
    for i in range(count):
        chosen = rng.choice(len(faces), CANDIDATES, p=length / length.sum())
        candidates = _places(faces[chosen], rng.uniform(0.05, 0.95, CANDIDATES))
        x, y, facing = candidates.T
        in_front = np.column_stack((x + IN_FRONT * np.cos(facing), y + IN_FRONT * np.sin(facing)))
        gaps = np.hypot(*(candidates[:, None, :2] - out[None, :i, :2]).transpose(2, 0, 1)).min(axis=1, initial=np.inf)
        out[i] = candidates[np.where(plan.open(in_front), gaps, -1.0).argmax()]
    return out.round(3)


def _points(plan: Plan, walls: Array, boxes: Array, count: int, rng: np.random.Generator) -> PointMap:
    """Return ``count`` points that are distributed over walls and furniture. Heights on walls are in the range
    :data:`POINT_HEIGHTS`, heights on furniture are below the top of the furniture."""
    places = _distribute(plan, np.concatenate((walls, boxes)), count, rng)
    x, y, facing = places.T
    back = np.column_stack((x - 2.0 * STANDOFF * np.cos(facing), y - 2.0 * STANDOFF * np.sin(facing)))
    on_wall = plan.open(back) | ~plan.indoors(back)
    low, high = POINT_HEIGHTS
    z = low + (np.where(on_wall, high, LOWEST_BOX) - low) * rng.random(count)
    return PointMap.of([f"P{i:04d}" for i in range(count)], np.column_stack((x, y, z.round(3))))


def _even(settings: WorldSettings, count: int) -> Array:
    """Return ``count`` places (count, 3) at equal distances along the two outer walls that are parallel to x. The
    columns are x, y and the direction [rad] away from the wall. An even number of places is symmetric to reflections
    and half-turns."""
    below, above = (count + 1) // 2, count // 2
    width, depth = settings.width, settings.depth
    rows = (((0.0, 0.0, width, 0.0), below), ((width, depth, 0.0, depth), above))
    return np.concatenate([_places(np.tile(face, (n, 1)), (np.arange(n) + 0.5) / max(n, 1)) for face, n in rows]).round(
        3
    )


def _places(faces: Array, along: Array) -> Array:
    """Return one place on each of N faces as (N, 3): x, y and the direction [rad] to the left of the face.

    ``faces`` (N, 4): segments. ``along`` (N,): the position of the place, as a fraction of the face's length.
    """
    dx, dy = faces[:, 2] - faces[:, 0], faces[:, 3] - faces[:, 1]
    facing = np.arctan2(dx, -dy)
    x = faces[:, 0] + along * dx + STANDOFF * np.cos(facing)
    y = faces[:, 1] + along * dy + STANDOFF * np.sin(facing)
    return np.column_stack((x, y, facing))

"""Worlds with tags, landmarks and points placed on a floor plan."""

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.map import Landmark
from factorgraph_loc.sensors.rfid.map import Tag
from factorgraph_loc.simulation.plans import LOWEST_BOX, Plan, make_plan
from factorgraph_loc.simulation.settings import WorldSettings
from factors.se2 import Array

STANDOFF = 0.02  # m, of a tag or point from its surface
POINT_HEIGHTS = (0.3, 2.2)  # m, range on walls
IN_FRONT = 0.3  # m of free space needed before a tag
CANDIDATES = 10  # candidate places for each tag, of which the farthest from the others is chosen


def make_world(settings: WorldSettings, rng: np.random.Generator) -> World:
    """A world with walls (including furniture and shelves), tags ``T000``..., landmarks ``L000``... and points ``P0000``....

    Tags on surfaces face away from them; hanging tags and those on the floor (at height 0) have no facing. Raises InputError if
    the plan lacks the surfaces.
    """
    plan = make_plan(settings, rng)
    tags: dict[str, Tag] = {}
    walls, boxes = plan.faces()
    count = settings.tag_count()
    upright = [faces for name, faces in (("wall", walls), ("shelf", boxes)) if name in settings.surfaces]
    faces = np.concatenate(upright) if upright else np.empty((0, 4))
    if settings.surfaces == ("shelf",) and not len(faces):
        raise InputError(f"world: plan {settings.plan} has no shelves of this size, expected other surfaces")
    if plan.hanging and count > len(plan.hanging):
        raise InputError(f"world: tags is {count}, expected at most {len(plan.hanging)} in plan {settings.plan}")
    on_floor = 0
    if "floor" in settings.surfaces and not plan.hanging:
        on_floor = round(count / len(settings.surfaces)) if len(faces) else count
    on_faces = 0 if plan.hanging else count - on_floor
    places = _even(settings, on_faces) if settings.even else _spread(plan, faces, on_faces, rng)
    for x, y, facing in places.tolist():
        tags[f"T{len(tags):03d}"] = Tag(x=x, y=y, z=settings.tag_height, facing=facing)
    for x, y in plan.hanging[:count]:
        tags[f"T{len(tags):03d}"] = Tag(x=x, y=y, z=settings.tag_height)
    for x, y in rng.uniform((0.2, 0.2), (plan.width - 0.2, plan.depth - 0.2), (on_floor, 2)).round(3).tolist():
        tags[f"T{len(tags):03d}"] = Tag(x=x, y=y, z=0.0)
    landmarks = _spread(plan, walls, settings.landmarks, rng)[:, :2].tolist()
    return World(
        name=settings.plan,
        tags=tags,
        landmarks={f"L{i:03d}": Landmark(x=x, y=y) for i, (x, y) in enumerate(landmarks)},
        points=_points(plan, walls, boxes, settings.points, rng) if settings.points else None,
        walls=tuple((a, b, c, d) for a, b, c, d in plan.segments().round(3).tolist()),
    )


def _spread(plan: Plan, faces: Array, count: int, rng: np.random.Generator) -> Array:
    """``count`` places (x, y, direction away from the surface) along ``faces`` (F, 4), by best-candidate sampling (Mitchell,
    SIGGRAPH 1991): each is the farthest from the previous ones among :data:`CANDIDATES`, uniform per metre. None is behind
    furniture.
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
    """Points spread over walls and furniture, at heights from :data:`POINT_HEIGHTS`, on furniture up to its top."""
    places = _spread(plan, np.concatenate((walls, boxes)), count, rng)
    x, y, facing = places.T
    behind = np.column_stack((x - 2.0 * STANDOFF * np.cos(facing), y - 2.0 * STANDOFF * np.sin(facing)))
    on_wall = plan.open(behind) | ~plan.indoors(behind)
    low, high = POINT_HEIGHTS
    z = low + (np.where(on_wall, high, LOWEST_BOX) - low) * rng.random(count)
    return PointMap.of([f"P{i:04d}" for i in range(count)], np.column_stack((x, y, z.round(3))))


def _even(settings: WorldSettings, count: int) -> Array:
    """``count`` places along the two long walls of the outline, invariant to mirroring and half-turns."""
    below, above = (count + 1) // 2, count // 2
    width, depth = settings.width, settings.depth
    rows = (((0.0, 0.0, width, 0.0), below), ((width, depth, 0.0, depth), above))
    return np.concatenate([_places(np.tile(face, (n, 1)), (np.arange(n) + 0.5) / max(n, 1)) for face, n in rows]).round(
        3
    )


def _places(faces: Array, along: Array) -> Array:
    """Places (N, 3) at fractions ``along`` (N,) of faces (N, 4): x, y, and the direction to their left."""
    dx, dy = faces[:, 2] - faces[:, 0], faces[:, 3] - faces[:, 1]
    facing = np.arctan2(dx, -dy)
    x = faces[:, 0] + along * dx + STANDOFF * np.cos(facing)
    y = faces[:, 1] + along * dy + STANDOFF * np.sin(facing)
    return np.column_stack((x, y, facing))

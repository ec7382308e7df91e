"""The tags of a map as arrays in the world frame."""

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.rfid.settings import SurveySettings
from factors import se2
from factors.rfid.detection import TagArray
from factors.se2 import Array


@dataclass(frozen=True, eq=False)
class TagMap:
    """``names``: T EPCs; ``tags``: in the world frame, with the survey transform applied; ``index``: by EPC; ``sigmas`` (T,) [m]:
    standard deviations of their survey along an axis."""

    names: tuple[str, ...]
    tags: TagArray
    index: dict[str, int]
    sigmas: Array


def tag_map(world: World, survey: SurveySettings, names: Collection[str] | None = None) -> TagMap:
    """The tags of a map, or those of them in ``names``."""
    chosen = {name: tag for name, tag in world.tags.items() if names is None or name in names}
    points = np.array([(tag.x, tag.y, tag.z) for tag in chosen.values()]).reshape(-1, 3)
    facing = np.array([np.nan if tag.facing is None else tag.facing for tag in chosen.values()])
    transform = survey.transform()
    points[:, :2] = se2.transform_from(transform, points[:, :2])
    tags = TagArray(points, facing + transform[2])
    sigmas = np.array([math.sqrt(np.trace(tag.spread()) / 2.0) for tag in chosen.values()])
    return TagMap(tuple(chosen), tags, {name: i for i, name in enumerate(chosen)}, sigmas)


MARGIN = 1.0  # m; distance from walls and tags at which the robot may be
MARGIN_OF_TAGS = 3.0  # m; without walls


def extent(world: World, tags: TagArray) -> Array:
    """The area of the robot: lower and upper corner (2, 2) [m], from the walls, or from the tags without walls."""
    ends = np.array(world.walls).reshape(-1, 2)
    margin = MARGIN if len(ends) else MARGIN_OF_TAGS
    points = np.concatenate((ends, tags.points[:, :2])) if len(tags.points) else ends
    if not len(points):
        return np.zeros((2, 2))
    return np.array((points.min(axis=0) - margin, points.max(axis=0) + margin))

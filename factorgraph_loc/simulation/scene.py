"""A textured building for rendering: vertical faces, floor and ceiling.

A face is a rectangle above a segment in the plan, visible from the segment's left side. Furniture is lower than the room, but
higher than cameras, so that its top is never visible.
Textures have mip levels (Williams, "Pyramidal parametrics", SIGGRAPH 1983).
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.sensors.rfid.map import Tag
from factorgraph_loc.simulation import textures
from factorgraph_loc.simulation.pictures import Canvas, paste
from factorgraph_loc.simulation.worlds import LOWEST_BOX, Plan, both_sides
from factors.se2 import Array

ROOM_HEIGHT = 2.7  # m
DOOR_HEIGHT = 2.05
HIGHEST_BOX = 2.0
TEXEL = 0.005  # m; larger in a building that would need more than MOST_TEXELS
MOST_TEXELS = 50e6  # three bytes each, plus a third for the mip levels
LEVELS = 7  # mip levels of a texture, including the first


@dataclass(frozen=True, eq=False)
class TexturedScene:
    """``faces`` (F, 4) [m]: segments visible from the left; ``bottoms`` and ``tops`` (F,) [m] of them.

    ``width``, ``depth``, ``height`` [m]: of floor and ceiling. ``texels`` (T, 3): BGR of all textures and levels; ``layout`` (F
    + 2, LEVELS, 3): first texel, width and height of each level, floor and ceiling last. Columns run along a face, left to
    right for the viewer, rows downwards; on floor and ceiling along x and y. ``texel`` [m].
    """

    faces: Array
    bottoms: Array
    tops: Array
    width: float
    depth: float
    height: float
    texels: NDArray[np.uint8]
    layout: NDArray[np.int64]
    texel: float


def make_scene(plan: Plan, tags: Sequence[Tag], rng: np.random.Generator) -> TexturedScene:
    """The building of a plan, with random textures and heights of furniture; tags with a facing appear as small labels."""
    walls, boxes = plan.faces()
    doors = np.array([side for door in plan.doors for side in both_sides(door)]).reshape(-1, 4)
    faces = np.concatenate((walls, boxes, doors))
    w, b, d = len(walls), len(boxes), len(doors)
    bottoms = np.concatenate((np.zeros(w + b), np.full(d, DOOR_HEIGHT)))
    of_boxes = rng.uniform(LOWEST_BOX, HIGHEST_BOX, b // 4).round(2).repeat(4)
    tops = np.concatenate((np.full(w, ROOM_HEIGHT), of_boxes, np.full(d, ROOM_HEIGHT)))
    lengths = np.hypot(faces[:, 2] - faces[:, 0], faces[:, 3] - faces[:, 1])
    area = float(lengths @ (tops - bottoms)) + 2.0 * plan.width * plan.depth
    texel = max(TEXEL, math.sqrt(area / MOST_TEXELS))
    sizes = [(max(round(z / texel), 8), max(round(x / texel), 8)) for z, x in zip(tops - bottoms, lengths, strict=True)]
    across = round(plan.depth / texel), round(plan.width / texel)
    are_outer = ~plan.indoors((faces[:, :2] + faces[:, 2:]) / 2.0)  # the outline itself is not indoors

    def drawn() -> Iterator[Canvas]:
        for i, size in enumerate(sizes):
            if i < w:
                canvas = textures.wall(rng, *size, texel, windows=bool(are_outer[i]))
            elif i < w + b:
                canvas = textures.furniture(rng, *size)
            else:
                canvas = textures.lintel(rng, *size, texel)
            for x, z in _places(tags, faces[i]):
                label = textures.label(rng, texel)
                row = (tops[i] - z) / texel - label.shape[0] / 2
                paste(canvas, label, round(x / texel - label.shape[1] / 2), round(row))
            yield canvas
        yield textures.floor(rng, *across, texel)
        yield textures.ceiling(rng, *across, texel)

    texels, layout = _stored([*sizes, across, across], drawn())
    return TexturedScene(faces, bottoms, tops, plan.width, plan.depth, ROOM_HEIGHT, texels, layout, texel)


def _places(tags: Sequence[Tag], face: Array) -> Iterator[tuple[float, float]]:
    """Positions [m] of the tags just before a face: distance from the viewer's left end, and height."""
    along = face[2:] - face[:2]
    length = math.hypot(*along)
    along = along / length
    normal = np.array((-along[1], along[0]))
    for tag in tags:
        offset = np.array((tag.x, tag.y)) - face[:2]
        s, away = float(offset @ along), float(offset @ normal)
        if tag.facing is None or not 0.0 <= s <= length or not 0.0 <= away < 0.05:
            continue
        if normal @ (math.cos(tag.facing), math.sin(tag.facing)) > 0.9:
            # the viewer stands on the segment's left side, so its end is on the viewer's left
            yield length - s, tag.z


def _stored(
    sizes: Sequence[tuple[int, int]], canvases: Iterable[Canvas]
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Pack canvases of the given sizes and their mip levels in one array."""
    layout = np.empty((len(sizes), LEVELS, 3), dtype=np.int64)
    total = 0
    for i, (height, width) in enumerate(sizes):
        for k in range(LEVELS):
            layout[i, k] = total, max(width >> k, 1), max(height >> k, 1)
            total += int(layout[i, k, 1] * layout[i, k, 2])
    texels = np.empty((total, 3), dtype=np.uint8)
    for levels, canvas in zip(layout.tolist(), canvases, strict=True):
        level = canvas
        for k, (first, width, height) in enumerate(levels):
            if k:
                level = np.asarray(cv2.resize(level, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
            texels[first : first + width * height] = level.reshape(-1, 3)
    return texels, layout

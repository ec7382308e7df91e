"""Reads walls from an occupancy map of ROS's map_server: an image of cells, and a YAML file that defines its grey levels."""

import math
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.bounded import IMAGE, opened
from factorgraph_loc.files.images import pillow_image
from factorgraph_loc.files.models import Coordinate, FileModel, InUnit, inside, parse_model
from factorgraph_loc.files.yaml import read_yaml
from factors import se2
from factors.se2 import Array

Wall = tuple[float, float, float, float]
Yaw = Annotated[float, Field(ge=-7.0, le=7.0), InUnit("rad")]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
# cells: tolerance of simplified outlines. It is above half a cell, so that the staircase of an oblique wall is a line
TOLERANCE = 0.75
STRIP = 256  # rows of the image that are processed together, to limit memory
MIN_EXTENT = 2.0  # cells: smaller groups of occupied cells are noise of the mapping sensor


class MapFile(FileModel):
    """The content of a map's YAML file for map_server (ROS or Nav2), whose documentation explains the keys. ``origin``:
    x, y [m] and yaw [rad] of the lower left corner of the image."""

    image: str
    resolution: Annotated[float, Field(ge=1e-4, le=10.0), InUnit("m per cell")]
    origin: tuple[Coordinate, Coordinate, Yaw]
    occupied_thresh: Share = 0.65
    free_thresh: Share = 0.196
    negate: bool = False
    mode: Literal["trinary", "scale", "raw"] = "trinary"
    map_type: Literal["occupancy"] = "occupancy"


def read_walls(path: Path) -> tuple[Wall, ...]:
    """Return the outlines of the occupied cells of a map as segments (x1, y1, x2, y2) [m] in the map's frame.

    ``path``: the YAML file of the map. Segments are at most :data:`TOLERANCE` cells from the centres of the outermost
    occupied cells. Groups smaller than :data:`MIN_EXTENT` are omitted. Raises InputError if the map is invalid.
    """
    stated = parse_model(MapFile, read_yaml(path), path)
    if stated.free_thresh >= stated.occupied_thresh:
        raise bad_field(
            path, "free_thresh", stated.free_thresh, f"less than occupied_thresh, {stated.occupied_thresh:g}"
        )
    # map savers name the image without a folder, but some navigation stacks write absolute paths
    image = inside(path.parent, Path(stated.image).name if Path(stated.image).is_absolute() else stated.image, path)
    occupied = _occupied(image, stated)
    if not occupied.any():
        raise InputError(
            f"{image}: has no occupied cells, expected cells above occupied_thresh {stated.occupied_thresh:g}"
        )
    lines = _outlines(occupied)
    if not len(lines):
        raise InputError(f"{image}: has only single occupied cells, expected walls of several cells")
    height = occupied.shape[0]
    columns, rows = lines[:, 0::2] + 0.5, height - (lines[:, 1::2] + 0.5)
    ends = np.stack((columns, rows), axis=-1).reshape(-1, 2) * stated.resolution
    placed: Array = se2.transform_from(np.array(stated.origin), ends).reshape(-1, 4)
    return tuple((float(a), float(b), float(c), float(d)) for a, b, c, d in np.round(placed, 6).tolist())


def _occupied(path: Path, stated: MapFile) -> NDArray[np.bool_]:
    """Return a mask (R, C) of the occupied cells of the map image ``path``, by rows and columns of the image.
    ``stated``: the content of the map's YAML file. Transparent cells are not occupied."""
    with opened(path, IMAGE) as file, pillow_image(file, path) as image:
        # the grey level of a colour is the mean of its channels, as in map_server
        mode = "RGBA" if "A" in image.getbands() or "transparency" in image.info else "RGB"
        out = np.empty((image.height, image.width), dtype=bool)
        for top in range(0, image.height, STRIP):  # converting the whole image in one step needs much memory
            strip = image.crop((0, top, image.width, min(top + STRIP, image.height))).convert(mode)
            out[top : top + STRIP] = _are_occupied(np.asarray(strip, dtype=np.uint8), stated)
    return out


def _are_occupied(values: NDArray[np.uint8], stated: MapFile) -> NDArray[np.bool_]:
    """Return a mask (R, C) of the occupied cells. ``values`` (R, C, 3 or 4): red, green, blue, opacity of each cell.
    ``stated``: the content of the map's YAML file, which has the thresholds."""
    grey = values[:, :, :3].mean(axis=2)
    if stated.mode == "raw":  # occupancy in percent, 255 where unknown
        return np.asarray((grey <= 100.0) & (grey >= 100.0 * stated.occupied_thresh))
    occupancy = grey / 255.0 if stated.negate else 1.0 - grey / 255.0
    opaque = values[:, :, 3] > 0 if values.shape[2] == 4 else np.ones(grey.shape, dtype=bool)
    return np.asarray((occupancy > stated.occupied_thresh) & opaque)


def _outlines(occupied: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the outlines of the cells of the mask ``occupied`` (R, C) as segments (W, 4): column and row of both
    ends."""
    import cv2  # noqa: PLC0415 - worlds without such a map need no OpenCV

    contours, _ = cv2.findContours(occupied.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    segments: dict[tuple[int, int, int, int], None] = {}
    for contour in contours:
        if math.hypot(*np.ptp(contour[:, 0], axis=0).tolist()) < MIN_EXTENT:
            continue
        corners = cv2.approxPolyDP(contour, TOLERANCE, True)[:, 0].tolist()
        for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
            if start != end:  # sorted ends, because a wall that is one cell wide is traced in both directions
                segments[(*min(start, end), *max(start, end))] = None
    return np.array(list(segments), dtype=np.int64).reshape(-1, 4)

"""Validation of pushed features and named points."""

from dataclasses import replace
from typing import Any

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.values import integers, names, numbers, within
from factorgraph_loc.model.measurement import Measurement, named
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.columns import FEATURES, SIGHTINGS
from factorgraph_loc.sensors.camera.measurement import PixelSightings
from factorgraph_loc.text import plain
from factorgraph_loc.vision.frame import CameraFrame

PIXELS = replace(SIGHTINGS["u"], name="pixels")
BYTE = replace(FEATURES["descriptors"], kind="whole", low=0.0, high=255.0)


def check_sightings(m: PixelSightings, where: str) -> dict[str, Any]:
    """The fields of named points; InputError names the first invalid one."""
    points = names(where, "points", m.points)
    return {"points": points, "pixels": within(where, PIXELS, m.pixels, (len(points), 2))}


def check_frame(m: CameraFrame, where: str) -> dict[str, Any]:
    """The fields of an image's features; InputError names the first invalid one."""
    pixels = numbers(where, "pixels", m.pixels)
    if pixels.ndim != 2:
        raise InputError(f"{where}: pixels has shape {pixels.shape}, expected (K, 2)")
    if not isinstance(m.feature, str):
        raise bad_field(where, "feature", m.feature, "the name of a feature")
    count = len(pixels)
    return {
        "pixels": within(where, FEATURES["pixels"], pixels, (count, 2)),
        "sizes": within(where, FEATURES["sizes"], m.sizes, (count,)),
        "descriptors": _descriptors(where, m.descriptors, count, m.feature),
        "tracks": integers(where, FEATURES["tracks"], m.tracks, count),
    }


def _descriptors(where: str, value: object, count: int | None, feature: str) -> Any:
    """Descriptors (K, D); bytes for a binary feature."""
    rows = numbers(where, "descriptors", value)
    if rows.ndim != 2 or len(rows) != count:
        raise InputError(f"{where}: descriptors has shape {rows.shape}, expected ({count}, D)")
    binary = feature == "orb"
    column = BYTE if binary else FEATURES["descriptors"]
    if (bad := column.outside(rows)).any():
        raise bad_field(where, "descriptors", float(rows[bad][0]), column.expected)
    return rows.astype(np.uint8 if binary else np.float32)


class Widths:
    """Descriptor lengths by feature: those of the map, or of the first frame."""

    def __init__(self, rig: Rig, world: World) -> None:
        points = world.points
        self._known = {} if points is None or not points.feature else {points.feature: points.descriptors.shape[1]}

    def require(self, m: Measurement) -> None:
        """InputError if the descriptors have another length."""
        if not isinstance(m, CameraFrame) or not len(m.pixels):
            return
        width = m.descriptors.shape[1]
        if width != self._known.setdefault(m.feature, width) or not width:
            expected = f"{self._known[m.feature]} numbers each, as in earlier {plain(m.feature)}"
            raise bad_field(named(m), "length of descriptors", width, expected)

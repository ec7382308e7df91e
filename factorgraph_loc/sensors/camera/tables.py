"""The tables of cameras, images of a log in the native format, and validation of pushed features and named points.

Images are decoded and checked later, by :mod:`factorgraph_loc.sensors.camera.frontend`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks, values
from factorgraph_loc.files.bounded import NoFileNameError, copy_file
from factorgraph_loc.files.columns import LARGEST_PIXEL, PIXELS, PURE, STAMP, Column, Table, named, number, within
from factorgraph_loc.files.models import inside
from factorgraph_loc.files.tables import TableRows
from factorgraph_loc.model.measurement import Measurement, Stream
from factorgraph_loc.model.measurement import named as name_of
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.measurement import ImageStream, PixelSightings
from factorgraph_loc.sensors.tables import Columns, Reading, Writing
from factorgraph_loc.text import plain
from factorgraph_loc.vision.frame import CameraFrame

CAMERA = Table("camera", (STAMP, named("file", "the name of an image", "file")), "one each")
SIGHTINGS = Table(
    "sightings",
    (
        STAMP,
        named("landmark", "the name of a landmark", field="point"),
        within("u", PIXELS, LARGEST_PIXEL, "to the right; may lie outside of the image"),
        within("v", PIXELS, LARGEST_PIXEL, "down"),
    ),
    "one measurement",
    stream="factorgraph_loc.sensors.camera.measurement:SightingStream",
)
# features of images, as pushed by a program
FEATURES = Table(
    "features",
    (
        STAMP,
        within("pixels", PIXELS, LARGEST_PIXEL, "position of the feature"),
        number("sizes", PIXELS, 1e-3, LARGEST_PIXEL, "size of the feature"),
        within("descriptors", PURE, 1e6, "descriptor of the feature"),
        Column("tracks", "whole", PURE, -(2.0**53), 2.0**53, False, "number of the track that the feature belongs to"),
    ),
    "one measurement",
)


FOLDER = "camera"


def make_images(table: TableRows, t0_ns: int, warnings: list[str], folder: Path | None = None) -> ImageStream:
    """The existing images in order of arrival; of several with one timestamp the last. They are in ``folder``, which must be
    validated, by default that of the native format.

    InputError if a path leaves the folder or is no regular file, or a timestamp is late by more than 0.5 s.
    """
    latest = checks.last_in_order(table.path, table.rows, table.t_ns, warnings).tolist()
    within = inside(table.path.parent, FOLDER, table.path) if folder is None else folder
    named = zip(table.rows.tolist(), table.names["file"], strict=True)
    paths = [_image(within, f"{table.path}:{row}", name) for row, name in named]
    keep = [i for i in latest if paths[i] is not None]
    if missing := [i for i in latest if paths[i] is None]:
        first = f"{table.names['file'][missing[0]]} of row {table.rows[missing[0]]}"
        warnings.append(
            f"{table.path}: {len(missing)} of {len(latest)} images are missing and skipped, the first is {first}"
        )
    t = checks.seconds(table.t_ns[keep], t0_ns)
    return ImageStream(t, [path for path in (paths[i] for i in keep) if path is not None])


def assemble(rows: Mapping[str, TableRows], reading: Reading) -> ImageStream:
    """The images in a log's folder."""
    return make_images(rows["camera"], reading.t0_ns, reading.warnings)


def disassemble(stream: Stream, writing: Writing) -> dict[str, Columns]:
    """The rows of images, which are copied to the folder; InputError for features, which cannot be written."""
    if not isinstance(stream, ImageStream):
        raise InputError(f"{writing.log}: camera holds features, expected the images they were computed from")
    return {
        "camera": {"t_ns": checks.absolute(stream.t, writing.t0_ns), "file": write_images(stream.file, writing.folder)}
    }


def write_images(files: Sequence[Path], folder: Path) -> list[str]:
    """Copy the images into the new folder ``camera`` in ``folder``, numbered, and return their names. InputError if one is
    missing."""
    target = folder / FOLDER
    target.mkdir()
    names = [f"{i:06d}{file.suffix}" for i, file in enumerate(files)]
    for file, name in zip(files, names, strict=True):
        _copy(file, target / name)
    return names


def _copy(file: Path, target: Path) -> None:
    try:
        copy_file(file, target)
    except OSError as error:
        raise InputError(f"{file}: cannot be copied into {target.parent}: {error.strerror}") from error


def _image(folder: Path, source: str, name: str) -> Path | None:
    """The path of an image in ``folder``, or None if there is no such file."""
    try:
        path = inside(folder, name, source)
    except NoFileNameError:
        return None
    return path if path.is_file() else None


PAIRS = replace(SIGHTINGS["u"], name="pixels")
BYTE = replace(FEATURES["descriptors"], kind="whole", low=0.0, high=255.0)


def check_sightings(m: PixelSightings, where: str) -> dict[str, Any]:
    """The fields of named points; InputError names the first invalid one."""
    points = values.names(where, "points", m.points)
    return {"points": points, "pixels": values.within(where, PAIRS, m.pixels, (len(points), 2))}


def check_frame(m: CameraFrame, where: str) -> dict[str, Any]:
    """The fields of an image's features; InputError names the first invalid one."""
    pixels = values.numbers(where, "pixels", m.pixels)
    if pixels.ndim != 2:
        raise InputError(f"{where}: pixels has shape {pixels.shape}, expected (K, 2)")
    if not isinstance(m.feature, str):
        raise bad_field(where, "feature", m.feature, "the name of a feature")
    count = len(pixels)
    return {
        "pixels": values.within(where, FEATURES["pixels"], pixels, (count, 2)),
        "sizes": values.within(where, FEATURES["sizes"], m.sizes, (count,)),
        "descriptors": _descriptors(where, m.descriptors, count, m.feature),
        "tracks": values.integers(where, FEATURES["tracks"], m.tracks, count),
    }


def _descriptors(where: str, value: object, count: int | None, feature: str) -> Any:
    """Descriptors (K, D); bytes for a binary feature."""
    rows = values.numbers(where, "descriptors", value)
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
            raise bad_field(name_of(m), "length of descriptors", width, expected)

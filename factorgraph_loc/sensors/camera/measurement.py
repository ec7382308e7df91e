"""Measurements of cameras: images, features of images, and named points in images, with their streams and tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files import checks, values
from factorgraph_loc.files.bounded import NoFileNameError, copy_file
from factorgraph_loc.files.columns import LARGEST_PIXEL, PIXELS, PURE, STAMP, Column, Table, named, within
from factorgraph_loc.files.models import inside
from factorgraph_loc.model.measurement import Measurement, Stream
from factorgraph_loc.sensors.tables import Columns, Reading, Writing
from factorgraph_loc.text import Notice, notice
from factorgraph_loc.vision.frame import CameraFrame
from factors.se2 import Array

if TYPE_CHECKING:
    from factorgraph_loc.files.tables import TableRows


CAMERAS = ("camera", "sightings")  # channels of a camera: images (or their features), and named points in images


@dataclass(frozen=True, slots=True)
class PixelSightings:
    """K named points in an image at the time ``t`` [s]. ``points``: the names. ``pixels`` (K, 2): the positions in the
    image [px], x to the right, y down."""

    sensor: ClassVar[str] = "sightings"
    modality: ClassVar[str] = "camera"
    is_motion: ClassVar[bool] = False
    frame: ClassVar[None] = None  # a CameraFrame has features here
    t: float
    points: tuple[str, ...]
    pixels: Array
    source: str = modality

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the points."""
        return self.points

    @property
    def count(self) -> int:
        """The number of points."""
        return len(self.pixels)


@dataclass(frozen=True, slots=True)
class CameraImage:
    """An image for the live localizer, taken at the time ``t`` [s]. ``pixels``: an array (H, W) or (H, W, 3) in the
    order BGR, see :func:`factorgraph_loc.vision.images.as_image`."""

    sensor: ClassVar[str] = "camera"
    modality: ClassVar[str] = "camera"
    is_motion: ClassVar[bool] = False
    count: ClassVar[int] = 1
    t: float
    pixels: Any
    source: str = modality


Pixels = PixelSightings | CameraFrame  # measurements of a camera that estimators process


@dataclass(frozen=True)
class SightingStream(Stream):
    """All N named points in images of a log, one per row. ``point``: the names. ``u``, ``v`` (N,): the image positions
    [px]. Rows with equal timestamps form one measurement."""

    kind: ClassVar[type[Any]] = PixelSightings
    point: Sequence[str]
    u: Array
    v: Array

    def measurements(self, offset: float) -> Iterator[Measurement]:
        for i, j in self.scans():
            pixels = np.column_stack((self.u[i:j], self.v[i:j]))
            source = self.source or PixelSightings.modality
            yield PixelSightings(float(self.t[i]) + offset, tuple(self.point[i:j]), pixels, source)


@dataclass(frozen=True)
class ImageStream(Stream):
    """The N images of a log. ``file``: the paths of the images. For a run, they are replaced by a
    :class:`FeatureStream`."""

    kind: ClassVar[type[Any]] = CameraImage
    file: Sequence[Path]

    def measurements(self, offset: float) -> Iterator[Measurement]:
        raise InputError("images must be replaced by features before they are used as measurements")


@dataclass(frozen=True)
class FeatureStream(Stream):
    """The features of N images of a log. ``t`` (N,): the time [s] of each image. ``frame``: the features of each image.
    The timestamps inside ``frame`` are ignored."""

    kind: ClassVar[type[Any]] = CameraFrame
    frame: Sequence[CameraFrame]

    def measurements(self, offset: float) -> Iterator[Measurement]:
        for t, frame in zip((self.t + offset).tolist(), self.frame, strict=True):
            yield replace(frame, t=t, source=self.source or frame.source)


CAMERA = Table(
    "camera",
    (STAMP, named("file", "the name of an image", "file")),
    stream="factorgraph_loc.sensors.camera.measurement:ImageStream",
)
SIGHTINGS = Table(
    "sightings",
    (
        STAMP,
        named("landmark", "the name of a landmark", field="point"),
        within("u", PIXELS, LARGEST_PIXEL, "column of the point; may lie outside of the image"),
        within("v", PIXELS, LARGEST_PIXEL, "row of the point; may lie outside of the image"),
    ),
    stream="factorgraph_loc.sensors.camera.measurement:SightingStream",
    is_scan=True,
)
# fields of features that a program passes to the live localizer
FEATURES = Table(
    "features",
    (
        STAMP,
        within("pixels", PIXELS, LARGEST_PIXEL, "position of the feature"),
        within("descriptors", PURE, 1e6, "descriptor of the feature"),
        Column("tracks", "whole", PURE, -(2.0**53), 2.0**53, False, "number of the track that the feature belongs to"),
    ),
    stream="factorgraph_loc.sensors.camera.measurement:FeatureStream",
    is_scan=True,
)


FOLDER = "camera"


def make_images(table: TableRows, t0_ns: int, warnings: list[Notice], folder: Path | None = None) -> ImageStream:
    """Return the stream of the images that ``table`` lists. If images have the same timestamp, only the last is kept.

    ``t0_ns``: the absolute time of t = 0 [ns]. ``warnings``: a list to append a warning about missing images to.
    ``folder``: the folder of the images, by default ``camera`` next to the table. Raises InputError for a path outside
    of the folder and a path that is no file. Raises InputError if timestamps decrease by more than 0.5 s.
    """
    latest = checks.last_in_order(table.path, table.rows, table.t_ns, warnings, rules=table.rules).tolist()
    within = inside(table.path.parent, FOLDER, table.path) if folder is None else folder
    named = zip(table.rows.tolist(), table.names["file"], strict=True)
    paths = [_image(within, f"{table.path}:{row}", name) for row, name in named]
    keep = [i for i in latest if paths[i] is not None]
    if missing := [i for i in latest if paths[i] is None]:
        first = f"{table.names['file'][missing[0]]} of row {table.rows[missing[0]]}"
        sentence = "{source}: {missing} of {images} images are missing and skipped, the first is {first}"
        warnings.append(notice("missing_images", sentence, table.path, len(missing), len(latest), first))
    t = checks.seconds(table.t_ns[keep], t0_ns)
    return ImageStream(t, [path for path in (paths[i] for i in keep) if path is not None])


def assemble(rows: Mapping[str, TableRows], reading: Reading) -> ImageStream:
    """Return the images of a log in the native format as a stream. ``rows``: the rows by table name. ``reading``: the
    time origin, and a list to append warnings to."""
    return make_images(rows["camera"], reading.t0_ns, reading.warnings)


def disassemble(stream: Stream, writing: Writing) -> dict[str, Columns]:
    """Return the columns of the table "camera", and copy the images to ``writing.folder``. Raises InputError if
    ``stream`` consists of features instead of images."""
    if not isinstance(stream, ImageStream):
        raise InputError(f"{writing.log}: the stream camera has features, expected the images they were computed from")
    return {
        "camera": {"t_ns": checks.absolute(stream.t, writing.t0_ns), "file": write_images(stream.file, writing.folder)}
    }


def write_images(files: Sequence[Path], folder: Path) -> list[str]:
    """Copy the images ``files`` into a new folder ``camera`` in ``folder``. Returns the new file names, which are
    numbers in the order of ``files``. Raises InputError if an image is missing."""
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
    """Return the path of the image ``name`` in ``folder``, or None if there is no such file. ``source``: the file and
    row with the name, for error messages."""
    try:
        path = inside(folder, name, source)
    except NoFileNameError:
        return None
    return path if path.is_file() else None


PAIRS = replace(SIGHTINGS["u"], name="pixels")
BYTE = replace(FEATURES["descriptors"], kind="whole", low=0.0, high=255.0)


def check_sightings(m: PixelSightings, where: str) -> dict[str, Any]:
    """Return the validated fields of ``m`` by name. Raises InputError for the first invalid field. ``where``: the name
    of the measurement in error messages."""
    points = values.names(where, "points", m.points)
    return {"points": points, "pixels": values.within(where, PAIRS, m.pixels, (len(points), 2))}


def check_frame(m: CameraFrame | CameraImage, where: str) -> dict[str, Any]:
    """Return the validated fields of ``m`` by name, {} for a :class:`CameraImage`. Raises InputError for the first
    invalid field. ``where``: the name of the measurement in error messages."""
    if isinstance(m, CameraImage):
        return {}
    pixels = values.numbers(where, "pixels", m.pixels)
    if pixels.ndim != 2:
        raise InputError(f"{where}: pixels has shape {pixels.shape}, expected (K, 2)")
    if not isinstance(m.feature, str):
        raise bad_field(where, "feature", m.feature, "the name of a feature")
    count = len(pixels)
    return {
        "pixels": values.within(where, FEATURES["pixels"], pixels, (count, 2)),
        "descriptors": _descriptors(where, m.descriptors, count, m.feature),
        "tracks": values.integers(where, FEATURES["tracks"], m.tracks, count),
    }


def _descriptors(where: str, value: object, count: int | None, feature: str) -> Any:
    """Return ``value`` as validated descriptors (``count``, D): bytes if ``feature`` is a binary feature, otherwise
    floats. ``where``: the name of the measurement in error messages."""
    rows = values.numbers(where, "descriptors", value)
    if rows.ndim != 2 or len(rows) != count:
        raise InputError(f"{where}: descriptors has shape {rows.shape}, expected ({count}, D)")
    binary = feature == "orb"
    column = BYTE if binary else FEATURES["descriptors"]
    if (bad := column.outside(rows)).any():
        raise bad_field(where, "descriptors", float(rows[bad][0]), column.expected)
    return rows.astype(np.uint8 if binary else np.float32)

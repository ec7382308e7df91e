"""Summary of a log's images and named points, with warnings."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.camera.mounting_check import mounting_problems
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.stream import ImageStream, SightingStream
from factorgraph_loc.sensors.interfaces import Paragraph, Summary
from factorgraph_loc.vision.features import extractor
from factorgraph_loc.vision.images import read_image
from factorgraph_loc.vision.settings import FrontendSettings

LOOKED_AT = 40  # images that are examined, evenly over the log
SHOWN = 5  # names in a line


@dataclass(frozen=True)
class ImageSummary:
    """The images: their number; of the ``looked_at`` examined ones how many are ``readable``, their ``sizes`` (WIDTHxHEIGHT:
    count), the median number of ``features``, and the first ``fault``."""

    images: int
    looked_at: int
    readable: int
    sizes: Mapping[str, int]
    feature: str
    features: float
    fault: str | None


@dataclass(frozen=True)
class PixelSummary:
    """Named points. ``frames``: timestamps; ``known``: points of the map that are seen; ``unknown``: rows by names that the map
    lacks; ``outside``: rows outside of the image."""

    rows: int
    frames: int
    known: int
    unknown: Mapping[str, int]
    outside: int


def summarize(log: Log) -> Summary:
    """``images``, an :class:`ImageSummary`, and ``pixels``, a :class:`PixelSummary`; None if the log lacks the stream."""
    images, pixels = summarize_images(log), summarize_pixels(log)
    text = []
    if images is not None:
        sizes = ", ".join(images.sizes) or "unknown"
        text.append(
            f"images: {images.images}, of {sizes} px; {images.readable} of the {images.looked_at} examined can be read, "
            f"with {images.features:.0f} {images.feature} features (median)"
        )
    if pixels is not None:
        unknown = f"{len(pixels.unknown)} others" if pixels.unknown else "no others"
        text.append(
            f"identified pixels: {pixels.rows} in {pixels.frames} images, of {pixels.known} points of the map and {unknown}"
        )
    problems = camera_problems(log, images, pixels) + mounting_problems(log)
    return Summary({"images": images, "pixels": pixels}, {}, problems, tuple(map(Paragraph, text)))


def summarize_images(log: Log) -> ImageSummary | None:
    """Summary of the stream ``camera`` from some of its images, or None."""
    stream = log.streams.get("camera")
    if not isinstance(stream, ImageStream):
        return None
    places = np.linspace(0, len(stream.file) - 1, LOOKED_AT if len(stream.file) else 0)
    chosen = np.unique(places.round().astype(int)).tolist()
    sizes: Counter[str] = Counter()
    counts, fault = [], None
    wanted = _wanted(log)
    finder = extractor(*wanted)
    for i in chosen:
        try:
            image = read_image(stream.file[i])
        except InputError as error:
            fault = fault or str(error)
            continue
        sizes[f"{image.shape[1]}x{image.shape[0]}"] += 1
        counts.append(len(finder.detect(image)))
    median = float(np.median(counts)) if counts else 0.0
    return ImageSummary(len(stream.file), len(chosen), len(counts), dict(sizes), wanted[0], median, fault)


def summarize_pixels(log: Log) -> PixelSummary | None:
    """Summary of the stream ``sightings``, or None."""
    stream = log.streams.get("sightings")
    if not isinstance(stream, SightingStream):
        return None
    known = set(log.world.points.names) if log.world.points is not None else set()
    counts = Counter(stream.point)
    outside = 0
    if (camera := log.rig.find(CameraSettings)) is not None:
        inside = camera.model().contains(np.column_stack((stream.u, stream.v)))
        outside = int(np.count_nonzero(~inside))
    return PixelSummary(
        rows=len(stream.t),
        frames=len(np.unique(stream.t)),
        known=sum(name in known for name in counts),
        unknown={name: count for name, count in counts.most_common() if name not in known},
        outside=outside,
    )


def camera_problems(log: Log, images: ImageSummary | None, pixels: PixelSummary | None) -> list[str]:
    """Warnings about images and named points."""
    out = []
    if log.rig.find(CameraSettings) is None:
        there = [name for name, found in (("images", images), ("identified pixels", pixels)) if found is not None]
        out += [f"the log has {name}, but its rig has no [camera]: they are not used" for name in there]
    if images is not None:
        if images.fault is not None:
            lost = images.looked_at - images.readable
            out.append(f"{lost} of the {images.looked_at} examined images cannot be read: {images.fault}")
        if len(images.sizes) > 1:
            out.append(f"images have several sizes: {', '.join(images.sizes)}")
        out += _calibration(log, images)
        if images.readable and images.features == 0.0:
            out.append(f"half of the examined images, or more, show no {images.feature} features")
    if pixels is not None:
        if pixels.unknown:
            rows, names = sum(pixels.unknown.values()), list(pixels.unknown)
            more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
            out.append(
                f"{rows} sightings are of {len(names)} points that the map lacks: {', '.join(names[:SHOWN])}{more}"
            )
        if pixels.outside:
            out.append(f"{pixels.outside} of {pixels.rows} sightings lie outside of the camera's image")
    return out


def _wanted(log: Log) -> tuple[str, int]:
    camera = log.rig.find(CameraSettings)
    settings = FrontendSettings() if camera is None else camera.frontend
    return settings.feature, settings.count


def _calibration(log: Log, images: ImageSummary) -> list[str]:
    camera = log.rig.find(CameraSettings)
    if camera is None or not images.sizes:
        return []
    size = f"{camera.width}x{camera.height}"
    other = [s for s in images.sizes if s != size]
    if len(other) == len(images.sizes):
        return [f"the camera is calibrated for images of {size} px, those of the log have {other[0]} px"]
    return []

"""Summarises the images and named points of a log, with warnings, and provides the images for viewers.

The mounting of the camera is checked by the rotation of images. If a robot turns by an angle, the image rotates about
the optical axis by that angle times the downward component of the axis. Images of a camera that points at the floor
rotate with the robot, images of a camera that points forward only shift.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import IMAGE, read_bytes
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.camera.measurement import ImageStream, PixelSightings, SightingStream
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.use import frontend_of
from factorgraph_loc.sensors.interfaces import Marks, Paragraph, Summary
from factorgraph_loc.text import Notice, listed, notice
from factorgraph_loc.vision.features import extractor
from factorgraph_loc.vision.images import decoded, read_image
from factorgraph_loc.vision.matching import match
from factors import se2
from factors.se2 import Array

LOOKED_AT = 40  # maximum number of images that are examined, evenly over the log
SHOWN = 5  # number of names that a warning lists


@dataclass(frozen=True)
class ImageSummary:
    """A summary of the images of a log. ``images``: the number of images. ``looked_at``: the number of examined images.

    For the examined images: ``readable``: the number of readable images. ``sizes``: the number of images of each size
    WIDTHxHEIGHT. ``feature``: the kind of features. ``features``: the median number of features per image. ``fault``:
    the first error message, or None.
    """

    images: int
    looked_at: int
    readable: int
    sizes: Mapping[str, int]
    feature: str
    features: float
    fault: str | None


@dataclass(frozen=True)
class PixelSummary:
    """A summary of the named points in images of a log.

    ``rows``: the number of sightings. ``frames``: the number of images. ``known``: the number of sighted points that
    are in the map. ``unknown``: the number of sightings of each name that is not in the map. ``outside``: the number of
    sightings with a position outside of the image.
    """

    rows: int
    frames: int
    known: int
    unknown: Mapping[str, int]
    outside: int


def summarize(log: Log) -> Summary:
    """Return the summary of the camera in a log, with warnings. Its entry ``images`` is an :class:`ImageSummary`, its
    entry ``pixels`` is a :class:`PixelSummary`. Each is None if the log has no such data."""
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
            f"named points: {pixels.rows} in {pixels.frames} images, of {pixels.known} points of the map and {unknown}"
        )
    problems = camera_problems(log, images, pixels) + mounting_problems(log)
    return Summary({"images": images, "pixels": pixels}, {}, problems, tuple(map(Paragraph, text)))


def summarize_images(log: Log) -> ImageSummary | None:
    """Return a summary of the images of a log, or None if it has none. Only some images are examined."""
    stream = log.streams.get("camera")
    if not isinstance(stream, ImageStream):
        return None
    places = np.linspace(0, len(stream.file) - 1, LOOKED_AT if len(stream.file) else 0)
    chosen = np.unique(places.round().astype(int)).tolist()
    sizes: Counter[str] = Counter()
    counts, fault = [], None
    wanted = frontend_of(log.rig, log.world)
    finder = extractor(wanted.feature, wanted.count)
    for i in chosen:
        try:
            image = read_image(stream.file[i])
        except InputError as error:
            fault = fault or str(error)
            continue
        sizes[f"{image.shape[1]}x{image.shape[0]}"] += 1
        counts.append(len(finder.detect(image)))
    median = float(np.median(counts)) if counts else 0.0
    return ImageSummary(len(stream.file), len(chosen), len(counts), dict(sizes), wanted.feature, median, fault)


def summarize_pixels(log: Log) -> PixelSummary | None:
    """Return a summary of the named points in images of a log, or None if it has none."""
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


def camera_problems(log: Log, images: ImageSummary | None, pixels: PixelSummary | None) -> list[Notice]:
    """Return warnings about the images and named points of a log, such as unreadable images. ``images``, ``pixels``:
    the results of :func:`summarize_images` and :func:`summarize_pixels`."""
    out = list[Notice]()
    if log.rig.find(CameraSettings) is None:
        streams = [name for name, summary in (("images", images), ("named points", pixels)) if summary is not None]
        sentence = "the log has {stream}, which are not used, because its rig has no [camera]"
        out += [notice("unused_camera", sentence, name) for name in streams]
    if images is not None:
        if images.fault is not None:
            lost = images.looked_at - images.readable
            sentence = "{unreadable} of the {images} examined images cannot be read: {error}"
            out.append(notice("unreadable_images", sentence, lost, images.looked_at, images.fault))
        if len(images.sizes) > 1:
            out.append(notice("image_sizes", "images have several sizes: {sizes}", ", ".join(images.sizes)))
        out += _calibration(log, images)
        if images.readable and images.features == 0.0:
            sentence = "half of the examined images, or more, show no {feature} features"
            out.append(notice("no_features", sentence, images.feature))
    if pixels is not None:
        if pixels.unknown:
            rows, names = sum(pixels.unknown.values()), list(pixels.unknown)
            sentence = "{rows} sightings are of {points} points that the map lacks: {names}"
            out.append(notice("unknown_points", sentence, rows, len(names), listed(names, SHOWN)))
        if pixels.outside:
            sentence = "{outside} of {rows} sightings lie outside of the camera's image"
            out.append(notice("outside_image", sentence, pixels.outside, pixels.rows))
    return out


def _calibration(log: Log, images: ImageSummary) -> list[Notice]:
    """Return a list with a warning if no examined image has the size that the camera is calibrated for, else []."""
    camera = log.rig.find(CameraSettings)
    if camera is None or not images.sizes:
        return []
    size = f"{camera.width}x{camera.height}"
    sizes = [s for s in images.sizes if s != size]
    if len(sizes) == len(images.sizes):
        sentence = "the camera is calibrated for images of {expected} px, but the images of the log have {size} px"
        return [notice("image_size", sentence, size, sizes[0])]
    return []


PAIRS, FEWEST_PAIRS = 12, 5  # maximum and minimum number of pairs of successive images that are compared
TURNS = (0.03, 0.6)  # rad; minimum and maximum rotation of the robot between two compared images
FEATURE, COUNT, FEWEST_MATCHES = "orb", 400, 12
APART = 0.5  # maximum difference of the downward component of the optical axis (a unit vector) from that in the rig


def mounting_problems(log: Log) -> list[Notice]:
    """Return a list with a warning if the images rotate in another way than the camera's mounting in the rig predicts.
    Returns [] otherwise, and if the log lacks a camera, reference headings, or enough usable images."""
    stream, camera = log.streams.get("camera"), log.rig.find(CameraSettings)
    if not isinstance(stream, ImageStream) or camera is None or log.reference is None or not log.reference.has_heading:
        return []
    model = camera.model()
    ratios = [turned / turn for turn, turned in _turns(log, stream)]
    if len(ratios) < FEWEST_PAIRS:
        return []
    share = float(np.clip(np.median(ratios), -1.0, 1.0))  # downward component of the optical axis
    expected = -float(model.rotation[2, 2])
    if abs(share - expected) <= APART:
        return []
    where = "at the floor" if share > APART else "at the ceiling" if share < -APART else "ahead"
    sentence = (
        "images rotate {ratio:.2f} times as much as the robot, as if the camera points {where}; by the mounting the "
        "ratio is {expected:.2f}: is camera.pitch about {pitch:.1f}, not {stated:.1f}?"
    )
    return [notice("camera_mounting", sentence, share, where, expected, math.asin(share), camera.pitch)]


def _turns(log: Log, stream: ImageStream) -> Iterator[tuple[float, float]]:
    """Yield (rotation of the robot, rotation of the image) [rad] for pairs of successive images with a large rotation
    of the robot. Pairs are skipped if the rotation of the image cannot be estimated."""
    assert log.reference is not None
    headings = log.reference.at(stream.t + log.rig.time_offset("camera"))[:, 2]
    turns = se2.wrap(np.diff(headings))
    usable = np.flatnonzero((np.abs(turns) >= TURNS[0]) & (np.abs(turns) <= TURNS[1]))
    for i in sorted(usable[np.argsort(-np.abs(turns[usable]))][:PAIRS].tolist()):
        turned = _turned(stream.file[i : i + 2])
        if turned is not None:
            yield float(turns[i]), turned


def _turned(files: Sequence[Path]) -> float | None:
    """Return the rotation [rad] of the image content from the first to the second of two image ``files``. Returns None
    if it cannot be estimated. A positive rotation turns the right side of the image downwards."""
    finder = extractor(FEATURE, COUNT)
    features = []
    for file in files:
        try:
            features.append(finder.detectAndCompute(read_image(file)))
        except InputError:
            return None
    (first, of_first), (second, of_second) = features
    pairs = match(of_first, of_second).indices
    if len(pairs) < FEWEST_MATCHES:
        return None
    start, end = (keypoints.points[pairs[:, k]] for k, keypoints in enumerate((first, second)))
    motion, inliers = cv2.estimateAffinePartial2D(start, end, ransacReprojThreshold=3.0)
    if motion is None or np.count_nonzero(inliers) < FEWEST_MATCHES:
        return None
    return math.atan2(motion[1, 0], motion[0, 0])


JPEG_QUALITY = 90


def draw(log: Log) -> Marks:
    """Return the points of the map for plots and viewers."""
    points = log.world.points
    positions = np.empty((0, 3)) if points is None else points.positions
    return Marks(
        "points", () if points is None else points.names, positions, marker=".", size=2.0, order=1.0, dense=True
    )


def has_pictures(log: Log) -> bool:
    """Return True if the log has images or named points in images."""
    return "camera" in log.streams or "sightings" in log.streams


def images(log: Log) -> Iterator[tuple[float, bytes]]:
    """Yield the time [s] and the JPEG bytes of each image of a log. Raises InputError if an image cannot be read."""
    stream = log.streams.get("camera")
    if not isinstance(stream, ImageStream):
        return
    for t, file in zip((stream.t + log.rig.time_offset("camera")).tolist(), stream.file, strict=True):
        yield t, _jpeg(Path(file))


def sightings(log: Log) -> Iterator[tuple[float, tuple[str, ...], Array]]:
    """Yield the time [s] of each image of a log, and the names (K) and pixels (K, 2) of its K named points."""
    stream = log.streams.get("sightings")
    if not isinstance(stream, SightingStream):
        return
    for measurement in stream.measurements(log.rig.time_offset("sightings")):
        assert isinstance(measurement, PixelSightings)
        yield measurement.t, measurement.points, measurement.pixels


def _jpeg(file: Path) -> bytes:
    content = read_bytes(file, IMAGE)
    if content.startswith(b"\xff\xd8"):
        return content
    picture = decoded(content, file, cv2.IMREAD_COLOR)
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])

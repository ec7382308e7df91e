"""Detects features, tracks and fiducial markers in images: in all images of a log, or in one image after the other.

The images of a log are processed in parallel, and results are stored in the user's cache folder. A cache key is a hash
of image, settings and code. A changed image is computed again, and equal images of two logs are computed once.
"""

import hashlib
import json
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from pathlib import Path

import cv2
import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import IMAGE, read_bytes
from factorgraph_loc.maps.markers import MarkerFamily, corner_names
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.camera.measurement import FeatureStream, ImageStream, SightingStream
from factorgraph_loc.sensors.camera.settings import CameraSettings, FrontendSettings
from factorgraph_loc.text import Notice, notice
from factorgraph_loc.vision.feature_cache import FeatureCache, ImageFeatures, cache_folder, decode, encode
from factorgraph_loc.vision.features import Extractor, extractor
from factorgraph_loc.vision.fiducials import find_markers
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.images import as_image, read_image
from factorgraph_loc.vision.keypoints import Integers
from factorgraph_loc.vision.tracks import FeatureTracker
from factors.camera.model import CameraModel

# source files of factorgraph_loc.vision that compute cached features; cached tracks also depend on TRACK_CODE
FEATURE_CODE = (
    "colour_features.py",
    "descriptor.py",
    "detector.py",
    "feature_cache.py",
    "features.py",
    "images.py",
    "kernels.py",
    "keypoints.py",
    "scale_space.py",
    "weights.npz",
)
TRACK_CODE = ("matching.py", "tracks.py")

Size = tuple[int, int]  # width, height


@dataclass(frozen=True)
class _ImageFile:
    """An image file and the result of feature detection.

    ``key``: the cache key. ``found``: the features, None if not computed yet. ``fault``: the error message of an
    unusable file. ``other_size``: the size of the image if it is not the size of the rig's camera, otherwise None.
    """

    file: Path
    key: str = ""
    found: ImageFeatures | None = None
    fault: str = ""
    other_size: Size | None = None


def with_features(
    log: Log, settings: FrontendSettings, progress: Callable[[float], None] | None = None
) -> tuple[Log, tuple[Notice, ...]]:
    """Return the log with features and tracks instead of images, and warnings.

    An image that is missing, cannot be decoded or has another size than the rig's camera becomes a frame without
    features. ``progress`` is called with the completed fraction. A log without images is returned unchanged. Raises
    InputError if the rig has no camera, or if no image has the size that the camera is calibrated for.
    """
    stream = log.streams.get("camera")
    if not isinstance(stream, ImageStream):
        return log, ()
    if log.rig.find(CameraSettings) is None:
        raise InputError(
            f"{log.name}: has images, but its rig {log.rig.name} has no section [camera]: add it with focal length and mounting"
        )
    camera = log.rig.of(CameraSettings).model()
    kept = FeatureCache(cache_folder())
    images = _features(stream.file, settings, (camera.width, camera.height), kept, progress or (lambda _: None))
    _require_calibrated(log, images, camera)
    features = [image.found or _empty_features(settings) for image in images]
    tracks = _tracks(stream, images, features, settings, camera, kept)
    frames = [
        CameraFrame(t, settings.feature, f.pixels, f.descriptors, numbers)
        for t, f, numbers in zip(stream.t.tolist(), features, tracks, strict=True)
    ]
    streams = dict(log.streams) | {"camera": FeatureStream(stream.t, frames)}
    unkept = (notice("no_cache", "features are not cached, {error}", kept.fault),) if kept.fault else ()
    return replace(log, streams=streams), (*_doubts(log, images), *unkept)


def _features(
    files: Sequence[Path],
    settings: FrontendSettings,
    size: Size,
    kept: FeatureCache,
    progress: Callable[[float], None],
) -> list[_ImageFile]:
    """Return the image ``files`` with their features, from the cache ``kept`` if possible. ``size``: width and height
    of the camera's images [px]. ``progress`` is called with the completed fraction."""
    about = f"{settings.model_dump_json()} {size} {code_version(FEATURE_CODE)} "
    new: dict[str, _ImageFile] = {}
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # reading, hashing and detection release the interpreter lock
        images = list(pool.map(lambda file: _from_cache(file, about, kept), files))
        wanted = {image.key: image.file for image in images if image.found is None and not image.fault}
        if wanted:
            progress(0.0)
        for image in pool.map(lambda key: _find(wanted[key], key, settings, size, kept), wanted):
            new[image.key] = image
            progress(len(new) / len(wanted))
    if wanted:
        kept.trim()
    return [replace(new[image.key], file=image.file) if image.key in new else image for image in images]


def _from_cache(file: Path, about: str, kept: FeatureCache) -> _ImageFile:
    """Return an image file with its features from the cache ``kept``, or with the features None if the cache lacks
    them. The cache key is a hash of the bytes of ``file`` and of ``about``, a text with the settings of feature
    detection."""
    try:
        content = read_bytes(file, IMAGE)
    except InputError as error:
        return _ImageFile(file, fault=str(error))
    key = hashlib.sha256(about.encode() + content).hexdigest()
    stored = kept.read(key)
    return _ImageFile(file, key, None if stored is None else decode(stored))


def _find(file: Path, key: str, settings: FrontendSettings, size: Size, kept: FeatureCache) -> _ImageFile:
    """Return the image ``file`` with its detected features, or with the error message if it is unusable. The features
    are also written to the cache ``kept`` under ``key``. ``size``: width and height of the camera's images [px]."""
    try:
        image = read_image(file)
    except InputError as error:
        return _ImageFile(file, key, fault=str(error))
    height, width = image.shape[:2]
    if (width, height) != size:
        fault = f"{file}: has {width} x {height} px, expected {size[0]} x {size[1]}"
        return _ImageFile(file, key, fault=fault, other_size=(width, height))
    content = encode(*_extractor(settings).detectAndCompute(image))
    kept.write(key, content)
    return _ImageFile(file, key, decode(content))


_thread = threading.local()


def _extractor(settings: FrontendSettings) -> Extractor:
    """Return the feature extractor of the current thread. Threads cannot share one, because it reuses its memory."""
    if getattr(_thread, "settings", None) != settings:
        _thread.settings = settings
        _thread.extractor = extractor(settings.feature, settings.count, everywhere=settings.everywhere)
    kept: Extractor = _thread.extractor
    return kept


def _empty_features(settings: FrontendSettings) -> ImageFeatures:
    """Return features of length 0, to represent an image that cannot be used. Their type is that of detected
    features."""
    return decode(encode(*_extractor(settings).detectAndCompute(np.zeros((16, 16), dtype=np.uint8))))


def _tracks(
    stream: ImageStream,
    images: list[_ImageFile],
    features: list[ImageFeatures],
    settings: FrontendSettings,
    camera: CameraModel,
    kept: FeatureCache,
) -> list[Integers]:
    """Return the track number (K,) of each of the K ``features`` of each image, from the cache ``kept`` if possible.
    Features of the same point in several images have the same number. A feature without a match has its own number.
    ``images``: the files in the order of ``stream``. ``camera``: the lens model."""
    order = np.argsort(stream.t, kind="stable").tolist()
    about = f"tracks {settings.feature} {camera.intrinsics().tolist()} {code_version(TRACK_CODE)} "
    key = hashlib.sha256(
        (about + " ".join(images[i].key if images[i].found else "-" for i in order)).encode()
    ).hexdigest()
    counts = [len(features[i].pixels) for i in order]
    stored = kept.read(key)
    if stored is not None and len(stored) == 4 * sum(counts):
        numbers = np.frombuffer(stored, dtype="<i4").astype(np.int64)
    else:
        tracker = FeatureTracker(camera)
        lists = [tracker.follow(features[i].pixels, features[i].descriptors) for i in order]
        numbers = np.concatenate([*lists, np.empty(0, dtype=np.int64)])
        kept.write(key, numbers.astype("<i4").tobytes())
    tracks: list[Integers] = [numbers[:0]] * len(order)
    for i, part in zip(order, np.split(numbers, np.cumsum(counts)[:-1]), strict=False):
        tracks[i] = part
    return tracks


def _require_calibrated(log: Log, images: list[_ImageFile], camera: CameraModel) -> None:
    """Raise InputError if some ``images`` are readable, but none has the size that ``camera`` is calibrated for."""
    sizes = [image.other_size for image in images if image.other_size is not None]
    if sizes and not any(image.found for image in images):
        width, height = sizes[0]
        raise InputError(
            f"{log.name}: the rig's camera is calibrated for images of {camera.width} x {camera.height} px, but the images of "
            f"the log have {width} x {height} px, expected a calibration for this size"
        )


def _doubts(log: Log, images: list[_ImageFile]) -> tuple[Notice, ...]:
    """Return warnings about images that cannot be read, have a wrong size, or show no features."""
    doubts = []
    for kind, what, faults in (
        (
            "unreadable_images",
            "cannot be read",
            [image.fault for image in images if image.fault and image.other_size is None],
        ),
        ("image_sizes", "have another size", [image.fault for image in images if image.other_size is not None]),
    ):
        if faults:
            sentence = (
                f"{{log}}: {{faults}} of {{images}} images {what} and are without features, the first is {{first}}"
            )
            doubts.append(notice(kind, sentence, log.name, len(faults), len(images), faults[0]))
    if blank := sum(image.found is not None and len(image.found.pixels) == 0 for image in images):
        sentence = "{log}: {blank} of {images} images show no features"
        doubts.append(notice("no_features", sentence, log.name, blank, len(images)))
    return tuple(doubts)


@cache
def code_version(names: tuple[str, ...]) -> str:
    """Return a hash of the source files ``names`` of :mod:`factorgraph_loc.vision`, and of the versions of the
    libraries that these files use."""
    package = resources.files("factorgraph_loc.vision")
    digest = hashlib.sha256(f"{cv2.__version__} {np.__version__}".encode())
    for name in names:
        digest.update(package.joinpath(name).read_bytes())
    return digest.hexdigest()


CODE = ("fiducials.py", "images.py")  # source files that cached markers depend on
Marked = list[tuple[int, list[list[float]]]]  # the markers in an image: (number, pixels of the four corners)


def with_markers(log: Log, family: MarkerFamily) -> Log:
    """Return the log with a new stream ``sightings``: the corners of all markers of ``family`` detected in its images.

    Corners have names ``FAMILY-NUMBER/CORNER``. Results are cached. Raises InputError if the log has no images, or
    already has sightings.
    """
    stream = log.streams.get("camera")
    if not isinstance(stream, ImageStream) or not len(stream.t):
        raise InputError(f"{log.name}: has no images to detect markers in")
    if "sightings" in log.streams:
        remedy = "remove the table, or [markers] from the manifest"
        raise InputError(f"{log.name}: has a table of sightings, so markers cannot be detected: {remedy}")
    kept = FeatureCache(cache_folder())
    t: list[float] = []
    names: list[str] = []
    pixels: list[list[float]] = []
    faults: list[str] = []
    for stamp, file in zip(stream.t.tolist(), stream.file, strict=True):
        try:
            markers = _marked(file, family, kept)
        except InputError as error:
            faults.append(str(error))
            continue
        for number, corners in markers:
            names += corner_names(f"{family}-{number}")
            pixels += corners
            t += [stamp] * len(corners)
    kept.trim()
    warnings = []
    if faults:
        sentence = "markers: {images} images cannot be used, the first: {first}"
        warnings.append(notice("unreadable_images", sentence, len(faults), faults[0]))
    if not names:
        sentence = "markers: no marker of {family} was found in {images} images"
        warnings.append(notice("no_markers", sentence, family, len(stream.t)))
        return replace(log, warnings=(*log.warnings, *warnings))
    u, v = np.array(pixels).T
    return replace(
        log,
        streams={**log.streams, "sightings": SightingStream(np.array(t), names, u, v)},
        warnings=(*log.warnings, *warnings),
    )


def _marked(file: Path, family: MarkerFamily, kept: FeatureCache) -> Marked:
    """Return the markers of ``family`` in the image ``file``, from the cache ``kept`` if possible."""
    content = read_bytes(file, IMAGE)
    about = f"markers {family} {code_version(CODE)} "
    key = hashlib.sha256(about.encode() + content).hexdigest()
    stored = kept.read(key)
    if stored is not None:
        return [(int(number), corners) for number, corners in json.loads(stored)]
    markers = [(number, corners.tolist()) for number, corners in find_markers(read_image(file), family)]
    kept.write(key, json.dumps(markers).encode())
    return markers


class LiveFrontend:
    """Detects and tracks features in the images of a live camera, one image after the other. Not thread-safe."""

    def __init__(self, settings: FrontendSettings, camera: CameraModel) -> None:
        self._feature, self._camera = settings.feature, camera
        self._extractor = extractor(settings.feature, settings.count, everywhere=settings.everywhere)
        self._tracker = FeatureTracker(camera)

    def frame(self, t: float, image: object) -> CameraFrame:
        """Return the features of an image that was taken at ``t`` [s], with their track numbers.

        ``image``: an array, see :func:`~factorgraph_loc.vision.images.as_image`. Raises InputError if the array is
        invalid, or if the camera is calibrated for another image size.
        """
        pixels = as_image(image, f"CameraImage at {t:.3f} s")
        height, width = pixels.shape[:2]
        if (width, height) != (self._camera.width, self._camera.height):
            expected = f"{self._camera.width} x {self._camera.height}"
            raise InputError(f"CameraImage at {t:.3f} s: has {width} x {height} px, expected {expected}")
        features = decode(encode(*self._extractor.detectAndCompute(pixels)))
        numbers = self._tracker.follow(features.pixels, features.descriptors)
        return CameraFrame(t, self._feature, features.pixels, features.descriptors, numbers)

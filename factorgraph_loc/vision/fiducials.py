"""Fiducial markers in images, found by OpenCV (Garrido-Jurado et al., "Automatic generation and detection of highly reliable
fiducial markers under occlusion", Pattern Recognition 2014; for AprilTags their dictionaries, Olson, ICRA 2011).

Each corner of a marker is a point with a name, so that nothing but the reprojection of points is needed to use it. Where exactly
it is, is found by :mod:`factorgraph_loc.vision.marker_corners`.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from factorgraph_loc.bounded import IMAGE, read_bytes
from factorgraph_loc.errors import InputError
from factorgraph_loc.log import ImageStream, Log, SightingStream
from factorgraph_loc.markers import MarkerFamily, corner_names
from factorgraph_loc.vision.feature_cache import FeatureCache, cache_folder
from factorgraph_loc.vision.frontend import code_version
from factorgraph_loc.vision.images import Image, read_image
from factorgraph_loc.vision.marker_corners import refined_corners
from factors.se2 import Array

CODE = ("fiducials.py", "marker_corners.py", "images.py")  # what is found depends on
Marked = list[tuple[int, list[list[float]]]]  # numbers of markers, and the pixels of their corners


def find_markers(image: Image, family: MarkerFamily) -> list[tuple[int, Array]]:
    """The numbers of the markers in an image, and their corners (4, 2) [px]: upper left, upper right, lower right, lower left of
    the marker as it is printed. Of a number that is there twice neither is given."""
    grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    detector = _detector(family)
    corners, numbers, _ = detector.detectMarkers(grey)
    bits = detector.getDictionary().markerSize + 2
    found = [] if numbers is None else [int(number) for number in np.ravel(numbers)]
    count = Counter(found)
    pairs = zip(found, corners, strict=True)
    return [
        (number, refined_corners(grey, np.asarray(seen, dtype=float).reshape(4, 2), bits))
        for number, seen in pairs
        if count[number] == 1
    ]


def with_markers(log: Log, family: MarkerFamily) -> Log:
    """The log with the corners of the markers in its images as the stream ``sightings``, by the names ``FAMILY-NUMBER/CORNER``.

    What was found is kept in the user's cache. InputError for a log without images, or with identified pixels of its own.
    """
    stream = log.streams.get("camera")
    if not isinstance(stream, ImageStream) or not len(stream.t):
        raise InputError(f"{log.name}: has no images to look for markers in")
    if "sightings" in log.streams:
        raise InputError(f"{log.name}: has sightings already, expected either these or [markers]")
    kept = FeatureCache(cache_folder())
    t: list[float] = []
    names: list[str] = []
    pixels: list[list[float]] = []
    faults: list[str] = []
    for stamp, file in zip(stream.t.tolist(), stream.file, strict=True):
        try:
            seen = _marked(file, family, kept)
        except InputError as error:
            faults.append(str(error))
            continue
        for number, corners in seen:
            names += corner_names(f"{family}-{number}")
            pixels += corners
            t += [stamp] * len(corners)
    kept.trim()
    warnings = [f"markers: {len(faults)} images cannot be used, the first: {faults[0]}"] if faults else []
    if not names:
        warnings.append(f"markers: none of {family} is found in {len(stream.t)} images")
        return replace(log, warnings=(*log.warnings, *warnings))
    u, v = np.array(pixels).T
    return replace(
        log,
        streams={**log.streams, "sightings": SightingStream(np.array(t), names, u, v)},
        warnings=(*log.warnings, *warnings),
    )


def _marked(file: Path, family: MarkerFamily, kept: FeatureCache) -> Marked:
    content = read_bytes(file, IMAGE)
    about = f"markers {family} {code_version(CODE)} "
    key = hashlib.sha256(about.encode() + content).hexdigest()
    stored = kept.read(key)
    if stored is not None:
        return [(int(number), corners) for number, corners in json.loads(stored)]
    seen = [(number, corners.tolist()) for number, corners in find_markers(read_image(file), family)]
    kept.write(key, json.dumps(seen).encode())
    return seen


def _detector(family: MarkerFamily) -> cv2.aruco.ArucoDetector:
    name = f"DICT_{family.upper()}" if not family.startswith("tag") else f"DICT_APRILTAG_{family[3:].upper()}"
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)), parameters)

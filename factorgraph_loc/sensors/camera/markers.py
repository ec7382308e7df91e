"""Detection of fiducial markers in the images of a log."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import IMAGE, read_bytes
from factorgraph_loc.maps.markers import MarkerFamily, corner_names
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.camera.frontend import code_version
from factorgraph_loc.sensors.camera.stream import ImageStream, SightingStream
from factorgraph_loc.vision.feature_cache import FeatureCache, cache_folder
from factorgraph_loc.vision.fiducials import find_markers
from factorgraph_loc.vision.images import read_image

CODE = ("fiducials.py", "images.py")  # files that the result depends on
Marked = list[tuple[int, list[list[float]]]]  # marker numbers and the pixels of their corners


def with_markers(log: Log, family: MarkerFamily) -> Log:
    """Add the marker corners in the images of a log as the stream ``sightings``, with names ``FAMILY-NUMBER/CORNER``.

    Results are cached. InputError if the log has no images, or already has sightings.
    """
    stream = log.streams.get("camera")
    if not isinstance(stream, ImageStream) or not len(stream.t):
        raise InputError(f"{log.name}: has no images to detect markers in")
    if "sightings" in log.streams:
        raise InputError(f"{log.name}: already has sightings, expected either these or [markers]")
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
        warnings.append(f"markers: no marker of {family} was found in {len(stream.t)} images")
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

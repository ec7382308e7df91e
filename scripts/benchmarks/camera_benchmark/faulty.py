"""Faults of a camera, of its images, and of its calibration. Each fault is a function that returns a changed log."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.camera.frontend import with_features
from factorgraph_loc.sensors.camera.measurement import FeatureStream, ImageStream
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.use import frontend_of
from factorgraph_loc.simulation.filming import JPEG

EACH = 5  # number of images that are missing, truncated, and of another size
BLACK, BLACK_FROM = 100, 40.0  # number of black images, and time of the first [s]
BLIND_FROM, BLIND = 40.0, 60.0  # s: begin and duration
WRONG = 0.4  # fraction of the features
MOVED, MOVED_RADIUS = 1.0, 0.5  # m: displacement of points; size of the region that moves
FOCAL, OFFSET = 0.05, 0.1  # relative error of the focal length; error of the stamps [s]
PERIOD = 8.0  # s: period of the motion of the object that covers the images
GREY = 128  # value of the pixels if nothing is in view


@dataclass(frozen=True)
class Given:
    """The input of a fault: a ``log`` with image files, a random generator ``rng``, and a ``folder`` for changed images."""

    log: Log
    rng: np.random.Generator
    folder: Path


Change = Callable[[Given], Log]


def right(given: Given) -> Log:
    return given.log


def damaged(given: Given) -> Log:
    """Return the log with some image files missing, some truncated, and some of half the size."""
    stream = images_of(given.log)
    files = list(stream.file)
    given.folder.mkdir(parents=True, exist_ok=True)
    chosen = given.rng.permutation(len(files))[: 3 * EACH].tolist()
    for k, i in enumerate(chosen):
        path = given.folder / files[i].name
        if k % 3 == 0:
            path = given.folder / f"missing-{i}.jpg"
        elif k % 3 == 1:
            content = files[i].read_bytes()
            path.write_bytes(content[: len(content) // 2])
        else:
            save(path, cv2.resize(np.asarray(cv2.imread(str(files[i]))), None, fx=0.5, fy=0.5))
        files[i] = path
    return with_stream(given.log, replace(stream, file=files))


def black(given: Given) -> Log:
    """Return the log with a hundred consecutive black images."""
    stream = images_of(given.log)
    first = int(np.searchsorted(stream.t, BLACK_FROM))
    return blank(given.log, range(first, min(first + BLACK, len(stream.t))), 0, given.folder)


def nothing_in_view(given: Given) -> Log:
    """Return the log with images of a grey surface for one minute."""
    t = images_of(given.log).t
    return blank(given.log, np.flatnonzero((t >= BLIND_FROM) & (t < BLIND_FROM + BLIND)).tolist(), GREY, given.folder)


def object_in_the_way(given: Given) -> Log:
    """Return the log with a textured object that covers a third of each image and moves from side to side."""
    stream = images_of(given.log)
    given.folder.mkdir(parents=True, exist_ok=True)
    camera = camera_of(given.log)
    width = camera.width // 3
    noise = given.rng.integers(0, 256, (camera.height // 8, width // 8, 3), dtype=np.uint8)
    thing = cv2.resize(noise, (width, camera.height), interpolation=cv2.INTER_CUBIC)
    files = []
    for t, file in zip(stream.t.tolist(), stream.file, strict=True):
        image = np.asarray(cv2.imread(str(file)))
        left = round((camera.width - width) * 0.5 * (1.0 + math.sin(2.0 * math.pi * t / PERIOD)))
        image[:, left : left + width] = thing
        files.append(given.folder / file.name)
        save(files[-1], image)
    return with_stream(given.log, replace(stream, file=files))


def wrong_matches(given: Given) -> Log:
    """Return the log with exchanged descriptors of four in ten features of each image."""
    stream = features_of(given.log)
    frames = []
    for frame in stream.frame:
        rows = given.rng.permutation(len(frame.pixels))[: round(WRONG * len(frame.pixels))]
        descriptors = frame.descriptors.copy()
        descriptors[rows] = descriptors[np.roll(rows, 1)]
        frames.append(replace(frame, descriptors=descriptors))
    return with_stream(given.log, replace(stream, frame=frames))


def moved_landmark(given: Given) -> Log:
    """Return the log with a map in which the region with most points is moved by one metre."""
    points = given.log.world.points
    if points is None:
        return given.log
    cells = np.round(points.positions[:, :2] / MOVED_RADIUS)
    _, cell, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    chosen = cell.ravel() == int(np.argmax(counts))
    direction = given.rng.uniform(-math.pi, math.pi)
    positions = points.positions.copy()
    positions[chosen, :2] += MOVED * np.array((math.cos(direction), math.sin(direction)))
    moved = replace(points, positions=positions)
    return replace(given.log, world=given.log.world.model_copy(update={"points": moved}))


def wrong_focal(given: Given) -> Log:
    camera = camera_of(given.log)
    return with_camera(given.log, fx=camera.fx * (1.0 + FOCAL), fy=camera.fy * (1.0 + FOCAL))


def late_stamps(given: Given) -> Log:
    """Return the log with stamps of images that are too late."""
    stream = images_of(given.log)
    return with_stream(given.log, replace(stream, t=stream.t + OFFSET))


def estimated(change: Change, **uncertainty: float) -> Change:
    """Return a fault like ``change`` in which the wrong constant has an uncertainty, so that it is estimated."""

    def changed(given: Given) -> Log:
        log = change(given)
        return with_camera(log, uncertainty=camera_of(log).uncertainty.model_copy(update=uncertainty))

    return changed


def out_of_order(given: Given) -> Log:
    """Return the log in which every fifth image arrives after the next image."""
    stream = images_of(given.log)
    order = np.arange(len(stream.t))
    for i in range(0, len(order) - 1, 5):
        order[[i, i + 1]] = order[[i + 1, i]]
    return with_stream(given.log, ImageStream(stream.t[order], [stream.file[i] for i in order.tolist()]))


def other_resolution(given: Given) -> Log:
    """Return the log with a rig whose calibration is that of images of half the size."""
    camera = camera_of(given.log)
    halves = {name: getattr(camera, name) / 2.0 for name in ("fx", "fy", "cx", "cy")}
    return with_camera(given.log, width=camera.width // 2, height=camera.height // 2, **halves)


FAULTS: dict[str, Change] = {
    "none": right,
    "5 images missing, 5 truncated, 5 of another size": damaged,
    "100 black images": black,
    "nothing in view for 60 s": nothing_in_view,
    "40 % of the features look like others": wrong_matches,
    "an object covers a third of each image": object_in_the_way,
    "a landmark moved by 1 m": moved_landmark,
    "focal length 5 % too long": wrong_focal,
    "focal length 5 % too long, estimated": estimated(wrong_focal, focal=FOCAL),
    "stamps 100 ms late": late_stamps,
    "stamps 100 ms late, estimated": estimated(late_stamps, time_offset=OFFSET),
    "every fifth image after the next": out_of_order,
    "calibration of 320 x 240 px": other_resolution,
}


def camera_of(log: Log) -> CameraSettings:
    assert log.rig.camera is not None
    return log.rig.camera


def images_of(log: Log) -> ImageStream:
    stream = log.streams["camera"]
    assert isinstance(stream, ImageStream)
    return stream


def features_of(log: Log) -> FeatureStream:
    stream = with_features(log, frontend_of(log.rig, log.world))[0].streams["camera"]
    assert isinstance(stream, FeatureStream)
    return stream


def with_stream(log: Log, stream: ImageStream | FeatureStream) -> Log:
    return replace(log, streams={**log.streams, "camera": stream})


def with_camera(log: Log, **changes: Any) -> Log:
    return replace(log, rig=log.rig.model_copy(update={"camera": camera_of(log).model_copy(update=changes)}))


def blank(log: Log, which: Sequence[int], value: int, folder: Path) -> Log:
    """Return the log with the images ``which`` replaced by an image of one grey ``value``."""
    stream, camera = images_of(log), camera_of(log)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "blank.jpg"
    save(path, np.full((camera.height, camera.width, 3), value, dtype=np.uint8))
    files = list(stream.file)
    for i in which:
        files[i] = path
    return with_stream(log, replace(stream, file=files))


def save(path: Path, image: np.ndarray) -> None:
    path.write_bytes(cv2.imencode(".jpg", image, JPEG)[1].tobytes())

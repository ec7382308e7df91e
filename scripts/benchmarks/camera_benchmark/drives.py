"""Drives through rendered offices: the features of their images, stored in files, and the map from another drive.

Images are JPEG-compressed but not stored. Stored features are named by a hash of everything that they depend on.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import numpy as np

from factorgraph_loc.experiments.preparation import REFERENCE_HEADING_SIGMA, REFERENCE_POSITION_SIGMA
from factorgraph_loc.files.models import replacing
from factorgraph_loc.mapping.point_mapping import map_points, posed_frames
from factorgraph_loc.maps.points import PointMap, read_points, write_points
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.camera.frontend import FEATURE_CODE, TRACK_CODE, code_version
from factorgraph_loc.sensors.camera.measurement import FeatureStream, ImageStream
from factorgraph_loc.simulation import film, preset, simulate, with_images
from factorgraph_loc.simulation.filming import JPEG
from factorgraph_loc.simulation.settings import SimulationSettings
from factorgraph_loc.vision.feature_cache import decode, encode
from factorgraph_loc.vision.features import extractor
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.tracks import FeatureTracker

TAGS = 20
RATE, MAP_RATE = 5.0, 2.0  # images/s
FEATURE, COUNT = "colour", 500  # per image
MAP_DURATION = 600.0  # s
MAP_SEED = 100_000  # added to the seed of a drive for that of its mapping drive
SIGMAS = np.array(
    (REFERENCE_POSITION_SIGMA, REFERENCE_POSITION_SIGMA, REFERENCE_HEADING_SIGMA)
)  # of that drive's poses


@dataclass(frozen=True)
class Drive:
    """A drive with ``seed`` through the office ``world``, ``duration`` [s] long. ``everywhere``: features are detected in all parts
    of an image, as where there is no map."""

    world: int
    seed: int
    duration: float
    rate: float = RATE
    everywhere: bool = False

    def settings(self) -> SimulationSettings:
        changes: dict[str, Any] = {
            "world": {"tags": TAGS},
            "world_seed": self.world,
            "drive": {"duration": self.duration},
            "images": {"rate": self.rate},
            "rig": {"camera": {"frontend": {"feature": FEATURE, "count": COUNT, "everywhere": self.everywhere}}},
        }
        return preset("office", changes)

    def mapping(self) -> Drive:
        """The other drive through the same office, from which the map is learnt."""
        return replace(self, seed=self.seed + MAP_SEED, duration=MAP_DURATION, rate=MAP_RATE)


@dataclass(frozen=True)
class Seconds:
    """Times [s] to render all images of a drive, and to detect and track their features."""

    render: float
    find: float
    follow: float


def log_of(drive: Drive, folder: Path) -> tuple[Log, Seconds]:
    """The log of a drive with features and without a map of points; stored in ``folder``."""
    path = folder / f"{_key(drive)}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        _write_features(drive, path)
    log = simulate(drive.settings(), drive.seed)
    stream, seconds = _read_features(path)
    streams = {**log.streams, "camera": stream}
    rig = log.rig.model_copy(update={"sensors": (*log.rig.sensors, "camera")})
    return replace(log, streams=streams, rig=rig), seconds


def written(drive: Drive, folder: Path) -> Log:
    """The log of a drive with image files, stored in ``folder``, and without a map of points."""
    settings = drive.settings()
    log = simulate(settings, drive.seed)
    path = folder / f"{_key(drive)}-images"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as name:
            with_images(log, settings, drive.seed, Path(name))
            Path(name).rename(path)  # the context manager does not mind
    times = film(settings, drive.seed).stamps
    return replace(log, streams={**log.streams, "camera": ImageStream(times, sorted(path.glob("*.jpg")))})


def map_of(drive: Drive, folder: Path) -> PointMap:
    """The map from the mapping drive of a drive, with poses as accurate as a reference."""
    other = drive.mapping()
    path = folder / f"{_key(other)}-{code_of('calibration')}.points.parquet"
    if not path.exists():
        log, _ = log_of(other, folder)
        camera = other.settings().rig.camera
        assert camera is not None
        made = map_points(camera.model(), posed_frames(with_errors(log, other.seed), 0.0, 0.0))
        write_points(made.points, path)
    return read_points(path)


def with_map(log: Log, points: PointMap) -> Log:
    return replace(log, world=log.world.model_copy(update={"points": points}))


def with_errors(log: Log, seed: int) -> Log:
    """The log with a reference that has errors as stated."""
    truth = log.reference
    assert truth is not None
    noise = SIGMAS * np.random.default_rng(seed).standard_normal((len(truth), 3))
    spread = np.repeat(np.diag(SIGMAS**2)[None], len(truth), axis=0)
    return replace(log, reference=Trajectory(truth.t, truth.poses + noise, spread))


def images(settings: SimulationSettings, seed: int) -> Iterator[np.ndarray]:
    """The images of a drive after compression."""
    cv2.setNumThreads(1)
    for _, image in film(settings, seed):
        yield compressed(image)


def compressed(image: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.imdecode(cv2.imencode(".jpg", image, JPEG)[1], cv2.IMREAD_COLOR))


def _write_features(drive: Drive, path: Path) -> None:
    settings = drive.settings()
    assert settings.rig.camera is not None
    finder = extractor(FEATURE, COUNT, everywhere=drive.everywhere)
    contents: list[bytes] = []
    render = find = 0.0
    before = perf_counter()
    for image in images(settings, drive.seed):
        rendered = perf_counter()
        contents.append(encode(*finder.detectAndCompute(image)))
        render, find = render + rendered - before, find + perf_counter() - rendered
        before = perf_counter()
    found = [decode(content) for content in contents]
    before = perf_counter()
    tracker = FeatureTracker(settings.rig.camera.model(), binary=finder.binary)
    tracks = [tracker.follow(f.pixels, f.descriptors) for f in found]
    seconds = np.array((render, find, perf_counter() - before))
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            stamps=film(settings, drive.seed).stamps,
            content=np.frombuffer(b"".join(contents), dtype=np.uint8),
            lengths=np.array([len(content) for content in contents]),
            tracks=np.concatenate(tracks),
            seconds=seconds,
        )


def _read_features(path: Path) -> tuple[FeatureStream, Seconds]:
    with np.load(path) as stored:
        content, ends = stored["content"].tobytes(), np.cumsum(stored["lengths"]).tolist()
        found = [decode(content[a:b]) for a, b in zip([0, *ends[:-1]], ends, strict=True)]
        numbers = np.split(stored["tracks"], np.cumsum([len(f.pixels) for f in found])[:-1])
        t = stored["stamps"]
        frames = [
            CameraFrame(stamp, FEATURE, f.pixels, f.sizes, f.descriptors, tracks)
            for stamp, f, tracks in zip(t.tolist(), found, numbers, strict=True)
        ]
        return FeatureStream(t, frames), Seconds(*stored["seconds"].tolist())


def _key(drive: Drive) -> str:
    about = f"{drive.settings().model_dump_json()} {drive.seed} {code_of('simulation')} {code_version(FEATURE_CODE + TRACK_CODE)}"
    return hashlib.sha256(about.encode()).hexdigest()[:16]


@cache
def code_of(package: str) -> str:
    """A hash of the code of a package of the library."""
    digest = hashlib.sha256()
    folder = resources.files(f"factorgraph_loc.{package}")
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        if file.name.endswith(".py"):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:8]

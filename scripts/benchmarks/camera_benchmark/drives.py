"""Drives through rendered offices, and maps made from other drives through the same offices.

Images are stored in folders. The name of a folder is a hash of all settings and of the code that the images depend on.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_loc.experiments.preparation import REFERENCE_HEADING_SIGMA, REFERENCE_POSITION_SIGMA
from factorgraph_loc.mapping.point_mapping import map_points, posed_frames
from factorgraph_loc.maps.points import PointMap, read_points, write_points
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.camera.frontend import with_features
from factorgraph_loc.sensors.camera.measurement import ImageStream
from factorgraph_loc.simulation import film, preset, simulate, with_images
from factorgraph_loc.simulation.settings import SimulationSettings
from factorgraph_loc.vision.feature_cache import VARIABLE

TAGS = 20
RATE, MAP_RATE = 5.0, 2.0  # images/s of a drive, and of its mapping drive
FEATURE, COUNT = "colour", 500  # kind of features, and their number per image
MAP_DURATION = 600.0  # s
MAP_SEED = 100_000  # the seed of a mapping drive is that of the drive plus this number
SIGMAS = np.array(
    (REFERENCE_POSITION_SIGMA, REFERENCE_POSITION_SIGMA, REFERENCE_HEADING_SIGMA)
)  # of that drive's poses


@dataclass(frozen=True)
class Drive:
    """A drive through a simulated office. ``world``: the seed of the office. ``seed``: that of the drive. ``duration`` [s].
    ``rate``: images per second."""

    world: int
    seed: int
    duration: float
    rate: float = RATE

    def settings(self) -> SimulationSettings:
        changes: dict[str, Any] = {
            "world": {"tags": TAGS},
            "world_seed": self.world,
            "drive": {"duration": self.duration},
            "images": {"rate": self.rate},
            "rig": {"camera": {"frontend": {"feature": FEATURE, "count": COUNT}}},
        }
        return preset("office", changes)

    def mapping(self) -> Drive:
        """Return the mapping drive: another drive through the same office, from whose images the map is made."""
        return replace(self, seed=self.seed + MAP_SEED, duration=MAP_DURATION, rate=MAP_RATE)


def log_of(drive: Drive, folder: Path) -> Log:
    """Return the log of a drive with images, without a map of points. Images and their features are stored in ``folder``."""
    os.environ[VARIABLE] = str(folder / "features")
    settings = drive.settings()
    log = simulate(settings, drive.seed)
    path = folder / _key(drive)
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as name:
            with_images(log, settings, drive.seed, Path(name))
            Path(name).rename(path)  # the context manager accepts that its folder is gone
    times = film(settings, drive.seed).stamps
    return replace(log, streams={**log.streams, "camera": ImageStream(times, sorted(path.glob("*.jpg")))})


def map_of(drive: Drive, folder: Path) -> PointMap:
    """Return the map of points from the mapping drive of a drive. The poses of the mapping drive have the errors of a reference."""
    other = drive.mapping()
    path = folder / f"{_key(other)}-{code_of('mapping')}.points.parquet"
    if not path.exists():
        camera = other.settings().rig.camera
        assert camera is not None
        log, _ = with_features(log_of(other, folder), camera.frontend)
        made = map_points(camera.model(), posed_frames(with_errors(log, other.seed), 0.0, 0.0))
        write_points(made.points, path)
    return read_points(path)


def with_map(log: Log, points: PointMap) -> Log:
    return replace(log, world=log.world.model_copy(update={"points": points}))


def with_errors(log: Log, seed: int) -> Log:
    """Return the log with random errors added to its reference, and with their covariances."""
    truth = log.reference
    assert truth is not None
    noise = SIGMAS * np.random.default_rng(seed).standard_normal((len(truth), 3))
    spread = np.repeat(np.diag(SIGMAS**2)[None], len(truth), axis=0)
    return replace(log, reference=Trajectory(truth.t, truth.poses + noise, spread))


def _key(drive: Drive) -> str:
    about = f"{drive.settings().model_dump_json()} {drive.seed} {code_of('simulation')}"
    return hashlib.sha256(about.encode()).hexdigest()[:16]


@cache
def code_of(package: str) -> str:
    """Return a hash of the code of a package of factorgraph_loc."""
    digest = hashlib.sha256()
    folder = resources.files(f"factorgraph_loc.{package}")
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        if file.name.endswith(".py"):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:8]

"""Camera images of a simulated drive: single images, or image files of a log."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.processes import run_each
from factorgraph_loc.sensors.camera.measurement import ImageStream
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.interfaces import times as times_of
from factorgraph_loc.simulation.renderer import Image, Renderer, make_scene
from factorgraph_loc.simulation.settings import SimulationSettings
from factorgraph_loc.simulation.simulate import drive, generator, with_sensors
from factorgraph_loc.simulation.worlds import LOWEST_BOX, make_plan, make_world
from factors import se2
from factors.camera import model as reprojection
from factors.se2 import Array

# JPEG, because PNG is ten times as slow. Colours keep their full resolution, because colour features use colours.
JPEG = (
    cv2.IMWRITE_JPEG_QUALITY,
    95,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
)
MOMENT = 0.02  # s before and after an image, over which the robot's velocity is averaged
PERIODS, AMPLITUDE = (8.0, 13.0, 29.0), 0.1  # variations of the brightness: periods in s, relative amplitude of each
FEW = 40  # at most this many images are rendered by one process, because starting more processes takes longer


@dataclass(frozen=True, eq=False)
class Film:
    """The N images of a simulated drive. ``film[i]`` renders the image with index i, (H, W, 3) BGR.

    ``times`` (N,) [s]: the times of the middle of the exposures. ``stamps`` (N,) [s]: the same times by the camera's
    clock. ``truth``: the true trajectory of the robot. ``renderer``: renders the images, and computes the 3-D point of
    a pixel. ``seed``: the seed of the image noise.
    """

    renderer: Renderer
    truth: Trajectory
    times: Array
    stamps: Array
    seed: int

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, i: int) -> Image:
        t = float(self.times[i])
        model = self.renderer.model
        pose, speed = self.truth.at(np.array((t,)))[0], self._velocity(t)
        position, rotation = reprojection.camera_pose(model, pose)
        arm = position[:2] - pose[:2]
        velocity = np.array((speed[0] - speed[2] * arm[1], speed[1] + speed[2] * arm[0], 0.0))
        noise = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(11, i)))
        turn = np.array((0.0, 0.0, speed[2]))
        return self.renderer.image(position, rotation, velocity=velocity, turn=turn, gain=self._gain(t), rng=noise)

    def __iter__(self) -> Iterator[tuple[float, Image]]:
        """Yield the time stamp [s] by the camera's clock and the image (H, W, 3), one image after the other."""
        for i, stamp in enumerate(self.stamps.tolist()):
            yield stamp, self[i]

    def _velocity(self, t: float) -> Array:
        """Return the robot's velocity (3,) at time ``t`` in the world frame, in m/s, m/s and rad/s."""
        a, b = max(t - MOMENT, float(self.truth.t[0])), min(t + MOMENT, float(self.truth.t[-1]))
        earlier, later = self.truth.at(np.array((a, b)))
        change = later - earlier
        change[2] = se2.wrap_scalar(change[2])
        return np.asarray(change / (b - a))

    def _gain(self, t: float) -> float:
        phases = generator(self.seed, "exposure").uniform(0.0, 2.0 * np.pi, len(PERIODS))
        wave = sum(math.sin(2.0 * math.pi * t / period + phase) for period, phase in zip(PERIODS, phases, strict=True))
        return math.exp(AMPLITUDE * wave)


def film(settings: SimulationSettings, seed: int) -> Film:
    """Return the images of a simulated drive, which are rendered when they are requested.

    The function :func:`~factorgraph_loc.simulation.simulate` returns the log of the same drive for the same
    ``settings`` and ``seed``. Raises InputError if the rig has no camera, or if the camera is higher than the
    furniture.
    """
    camera = settings.rig.find(CameraSettings)
    if camera is None:
        raise InputError(f"rig {settings.rig.name}: has no camera, which is needed for images: add a section [camera]")
    if camera.z > LOWEST_BOX:
        raise InputError(
            f"rig {settings.rig.name}: camera.z is {camera.z:g}, expected at most {LOWEST_BOX:g} m for simulated images: "
            "furniture is rendered without an upper side"
        )
    world_seed = seed if settings.world_seed is None else settings.world_seed
    world = make_world(settings.world, generator(world_seed, "world"))
    plan = make_plan(settings.world, generator(world_seed, "world"))
    scene = make_scene(plan, list(world.tags.values()), generator(world_seed, "look"))
    truth = drive(world, settings.drive, generator(seed, "drive"))
    times = times_of(settings.images.rate, truth)
    return Film(Renderer(scene, camera.model(), settings.images), truth, times, times - camera.time_offset, seed)


def with_images(
    log: Log,
    settings: SimulationSettings,
    seed: int,
    folder: Path,
    *,
    workers: int = 1,
    progress: Callable[[float, float], None] = lambda _done, _total: None,
) -> Log:
    """Return a simulated log with images, which are rendered into files.

    ``log``: the log that was simulated with the same ``settings`` and ``seed``. ``folder``: receives the image files.
    ``workers``: the number of processes. ``progress``: is called with the number of finished images and the number of
    all images. Raises InputError if the rig has no camera, or if the camera is higher than the furniture.
    """
    assert log.reference is not None, "a simulated log has a reference"
    times = times_of(settings.images.rate, log.reference)
    count = len(times)
    if workers == 1 or count <= FEW:
        _write(settings, seed, folder, range(count), lambda done: progress(done, count))
    else:
        _write_in_parallel(settings, seed, folder, count, workers, progress)
    offset, names = log.rig.time_offset("camera"), [folder / _name(i) for i in range(count)]
    streams = {**log.streams, "camera": ImageStream(times - offset, names)}
    return replace(log, streams=streams, rig=with_sensors(log.rig, streams))


def _write_in_parallel(
    settings: SimulationSettings,
    seed: int,
    folder: Path,
    count: int,
    workers: int,
    progress: Callable[[float, float], None],
) -> None:
    """Render ``count`` images by ``workers`` processes, and write them into ``folder``. Each process creates the scene
    and renders every n-th image, where n is the number of processes. ``progress``: called with the numbers of finished
    and of all images."""
    write = partial(_write, settings, seed, folder)
    parts = [range(i, count, workers) for i in range(workers)]
    for _, outcome in run_each(
        write, parts, workers, beat=lambda: progress(sum(1 for _ in folder.glob("*.jpg")), count)
    ):
        if isinstance(outcome, Exception):
            raise outcome


def _write(
    settings: SimulationSettings,
    seed: int,
    folder: Path,
    indices: range,
    progress: Callable[[float], None] = lambda _done: None,
) -> None:
    cv2.setNumThreads(1)
    images = film(settings, seed)
    for done, i in enumerate(indices):
        _, content = cv2.imencode(".jpg", images[i], JPEG)
        (folder / _name(i)).write_bytes(content.tobytes())
        progress(done + 1)


def _name(i: int) -> str:
    return f"{i:06d}.jpg"

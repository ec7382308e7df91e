"""Simulation of a log: world, drive and measurements.

A robot follows shortest paths between random places. The simulation is reproducible from one seed. World, drive and each sensor
have random generators of their own, so that a change to one of them does not affect the random numbers of the others.
"""

import hashlib
import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.maps.free_space import SPACING, dense, free_space, shortest_path
from factorgraph_loc.model.log import Log, StartPose
from factorgraph_loc.model.measurement import of_sensor
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.interfaces import Ride, Simulated
from factorgraph_loc.sensors.registry import functions
from factorgraph_loc.simulation.settings import DriveSettings, SimulationSettings
from factorgraph_loc.simulation.worlds import make_world
from factorgraph_loc.version import __version__
from factors import se2
from factors.se2 import Array

# names of the random generators of a log; append only, because the index of a name determines its random sequence
NAMES = (
    "world",
    "drive",
    "odometry",
    "reads",
    "landmarks",
    "survey",
    "start",
    "strengths",
    "phases",
    "points",
    "look",
    "exposure",
)
LOOKAHEAD = 0.3  # m: distance of the point of the path that the robot steers towards
STEP = 0.02  # s, control period
GAIN = 4.0  # 1/s: turn rate of the robot per heading error
START_SIGMAS = np.array((0.1, 0.1, 0.05))  # m, m, rad: standard deviations of the start pose that a log states


def generator(seed: int | Any, name: str, names: tuple[str, ...] = NAMES) -> np.random.Generator:
    """Return a random generator that depends only on ``seed`` and ``name``. Generators with different names are
    independent.

    ``seed``: a number, or the seed sequence of another generator. The index of ``name`` in ``names`` is part of the
    seed, or the hash of ``name`` if it is not in ``names``.
    """
    digest = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8])
    key = names.index(name) if name in names else digest
    parent = np.random.SeedSequence(seed) if isinstance(seed, int) else seed
    return np.random.default_rng(np.random.SeedSequence(parent.entropy, spawn_key=(*parent.spawn_key, key)))


def drive(world: World, settings: DriveSettings, rng: np.random.Generator) -> Trajectory:
    """Return the poses of a simulated robot that drives between random places of a world, from t = 0 on. The rate of
    the poses is ``settings.rate``. Raises InputError if the world has no room to drive in."""
    space = free_space(world, settings.clearance)
    start = int(rng.integers(len(space.centres)))
    length, parts = 0.0, [space.centres[start][None]]
    while length < settings.duration * settings.speed:
        goal = int(rng.integers(len(space.centres)))
        if goal == start:
            if len(space.centres) == 1:
                raise InputError(
                    f"world {world.name} has no room for a robot: increase world.width and world.depth, or reduce drive.clearance"
                )
            continue
        leg = dense(shortest_path(space, start, goal))
        length += SPACING * len(leg)
        parts.append(leg)
        start = goal
    path = np.concatenate(parts)
    heading = rng.uniform(-math.pi, math.pi)
    return _follow(path, heading, settings)


def _follow(path: Array, heading: float, settings: DriveSettings) -> Trajectory:
    """Return the poses of a robot that follows a ``path`` (N, 2) by pure pursuit. It turns towards a point ahead on the
    path, and slows down if the heading error is large.

    ``heading`` [rad]: the heading at the start.
    """
    every = max(1, round(1.0 / (settings.rate * STEP)))
    step = 1.0 / (settings.rate * every)
    count = int(settings.duration * settings.rate + 1e-9)
    points = path.tolist()
    (x, y), aim, last = points[0], 0, len(points) - 1
    poses = [(x, y, heading)]
    for _ in range(count):
        for _ in range(every):
            while aim < last and math.hypot(points[aim][0] - x, points[aim][1] - y) < LOOKAHEAD:
                aim += 1
            error = se2.wrap_scalar(math.atan2(points[aim][1] - y, points[aim][0] - x) - heading)
            turn = step * min(max(GAIN * error, -settings.turn_rate), settings.turn_rate)
            advance = step * settings.speed * max(0.0, math.cos(error)) ** 2
            p, q = se2.arc_coefficients(turn)
            c, s = math.cos(heading), math.sin(heading)
            x, y = x + advance * (c * p - s * q), y + advance * (s * p + c * q)
            heading = se2.wrap_scalar(heading + turn)
        poses.append((x, y, heading))
    return Trajectory(np.arange(count + 1) / settings.rate, np.array(poses))


def simulate(settings: SimulationSettings, seed: int) -> Log:
    """Return a simulated log. The same ``settings`` and ``seed`` give exactly the same log.

    The log has odometry, RFID reads, and measurements of landmarks and points if the world has such objects. Sensors
    from plugins add their streams. The reference is the true trajectory. The start pose has a random error with the
    standard deviations :data:`START_SIGMAS`. Raises InputError if the world has no room for the tags or for the robot.
    """
    of_world = seed if settings.world_seed is None else settings.world_seed
    world = make_world(settings.world, generator(of_world, "world"))
    truth = drive(world, settings.drive, generator(seed, "drive"))
    ride = Ride(settings, settings.rig, world, truth, partial(generator, seed), partial(generator, of_world))
    made = [simulated(function, ride, name) for name, function in functions("simulate", settings.rig)]
    streams = {name: stream for simulated in made for name, stream in simulated.streams.items()}
    start = truth.poses[0] + START_SIGMAS * generator(seed, "start").standard_normal(3)
    start[2] = se2.wrap_scalar(start[2])
    metadata = {"origin": f"simulated by fgloc {__version__}", "preset": settings.name, "seed": str(seed)}
    if settings.world_seed is not None:
        metadata["world_seed"] = str(settings.world_seed)
    return Log(
        name=f"{settings.name}-{seed}",
        rig=with_sensors(settings.rig, streams),
        world=world.model_copy(update={name: layer for simulated in made for name, layer in simulated.layers.items()}),
        streams=streams,
        reference=truth,
        start=StartPose(0.0, start, START_SIGMAS.copy()),
        metadata=metadata | {key: value for simulated in made for key, value in simulated.metadata.items()},
    )


def simulated(function: Callable[[Ride], Simulated], ride: Ride, name: str) -> Simulated:
    """Return the simulated measurements of the sensor ``name`` on a drive.

    ``function``: simulates a sensor of this kind. ``ride``: the drive, with its world, settings and random generators.
    If a rig has several sensors of one kind, such as ``camera.front``, each has random generators of its own.
    """
    kind, _, own = name.partition(".")
    if not own:
        return function(ride)
    made = function(replace(ride, rig=ride.rig.alone(name), rng=lambda label: ride.rng(f"{label}.{own}")))
    streams = {name if channel == kind else channel: stream for channel, stream in made.streams.items()}
    return replace(made, streams={channel: of_sensor(stream, channel) for channel, stream in streams.items()})


def with_sensors(rig: Rig, streams: Iterable[str]) -> Rig:
    """Return the rig with the names ``streams`` appended to ``rig.sensors``, the default sensors of estimators."""
    sensors = (*rig.sensors, *(name for name in streams if name not in rig.sensors))
    return rig.model_copy(update={"sensors": sensors})

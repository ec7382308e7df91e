"""Simulated drives: a robot that follows shortest paths between random places."""

import math

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.maps.free_space import SPACING, dense, free_space, shortest_path
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.simulation.settings import DriveSettings
from factors import se2
from factors.se2 import Array

LOOKAHEAD = 0.3  # m: distance of the point of the path that the robot steers towards
STEP = 0.02  # s, control period
GAIN = 4.0  # rad/s per rad of heading error


def drive(world: World, settings: DriveSettings, rng: np.random.Generator) -> Trajectory:
    """Poses at ``settings.rate`` from t = 0 to the duration, of a robot that drives between random places."""
    space = free_space(world, settings.clearance)
    here = int(rng.integers(len(space.centres)))
    length, parts = 0.0, [space.centres[here][None]]
    while length < settings.duration * settings.speed:
        there = int(rng.integers(len(space.centres)))
        if there == here:
            if len(space.centres) == 1:
                raise InputError(f"world {world.name}: has no room to drive in, expected a larger one")
            continue
        leg = dense(shortest_path(space, here, there))
        length += SPACING * len(leg)
        parts.append(leg)
        here = there
    path = np.concatenate(parts)
    heading = rng.uniform(-math.pi, math.pi)
    return _follow(path, heading, settings)


def _follow(path: Array, heading: float, settings: DriveSettings) -> Trajectory:
    """Pure pursuit: turn towards a point ahead on the path, and slow down for large heading errors."""
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

"""Poses of a robot that drives, and noise of its wheels."""

import numpy as np

from factorgraph_loc.sensors.odometry.settings import GrowthSettings, OdometryNoise
from factors import se2


def even_noise(**growth):
    """The same growth along the way, across it, and of the heading."""
    return OdometryNoise(**dict.fromkeys(("along", "lateral", "heading"), GrowthSettings(**growth)))


def driven(steps, start=(0.0, 0.0, 0.0)):
    """The poses (N + 1, 3) of a robot that moves by ``steps`` (N, 3), each as seen from where it stands."""
    poses = [np.array(start)]
    for step in steps:
        poses.append(se2.compose(poses[-1], step))
    return np.array(poses)


def variance(growth, distance, rotation, duration):
    """The variance that an error grows to over a distance [m], a rotation [rad] and a duration [s]."""
    return growth.per_distance**2 * distance + growth.per_rotation**2 * rotation + growth.per_time**2 * duration


def slipped(v, w, seconds, noise, rng):
    """The moves (N, 3) of a robot that slips off what its wheels report, v [m/s] and w [rad/s] for ``seconds`` each."""
    growth = [g.model() for g in (noise.along, noise.lateral, noise.heading)]
    ways, turns = np.abs(v) * seconds, np.abs(w) * seconds
    variances = [[variance(g, way, turn, seconds) for g in growth] for way, turn in zip(ways, turns, strict=True)]
    off = rng.standard_normal((len(v), 3)) * np.sqrt(variances)
    return se2.compose(se2.exp(np.column_stack((v, 0.0 * v, w)) * seconds), se2.exp(off))

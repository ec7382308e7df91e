"""Expected information of a path: the entropy of the belief, minus the expected entropy after the measurements on the path.

The information ``h[p(x)] - E_z h[p(x | z, a)]`` is to be maximised. x is the pose, z are the measurements, and a is the path.
Measurements are drawn from the sensor models at particles of the belief, and all particles are weighted by them. The entropy is
that of the weighted particles. All paths use the same particles and random numbers. The differences between paths therefore have
less variance than the information itself (common random numbers: Glasserman, Yao, Management Science 38(6), 1992).

Entropies are differential, in nats. For a belief with one mode, the entropy is that of a Gaussian with the particles'
covariance. For a belief with several modes, it is that of a histogram.

If the pose is nearly known, the information is computed in closed form (:func:`fisher_gain`), without drawing
measurements. A Gaussian belief is propagated along the path with the noise of the odometry. At each pose of the path
the expected Fisher information of the sensors is added (van Trees, "Detection, Estimation, and Modulation Theory", part
I, 1968, section 2.4: the Cramer-Rao bound). This is valid while the sensor models are nearly linear over the belief.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.fusion.cloud import pose_moments, systematic
from factorgraph_loc.maps.free_space import FreeSpace
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.planning import particle_kernels
from factorgraph_loc.planning.paths import Path, free_steps
from factorgraph_loc.sensors.interfaces import Array32, Forecast, Places
from factorgraph_loc.sensors.motion import odometry_model
from factorgraph_loc.sensors.registry import functions
from factors import se2
from factors.motion import ChainState, propagate
from factors.odometry import model as odometry
from factors.odometry.model import OdometryModel
from factors.se2 import Array

POSITION, POSE = 2, 3  # entropies are of this number of leading coordinates of a pose (x, y, heading)
CELL = np.array((0.5, 0.5, 2.0 * math.pi / 20.0))  # m, m, rad: cells of histograms; a full turn has 20 cells
FINEST = np.array((0.1, 0.1, 0.05))  # m, m, rad: a standard deviation below these values is not counted as a gain
# m: distance along a path between two stations, the poses at which measurements are predicted
STATION_DISTANCE = 1.5
MOST_STATIONS = 10  # largest number of stations; on a longer path they are farther apart
SAMPLES, SCANS = 256, 48  # number of particles, and number of simulated measurements of a path that weight them
FEWEST = 10  # least number of particles
SEVERAL = 0.5  # nats: see :func:`has_several_modes`
WIDEST_HEADING = 0.8  # rad: with a larger standard deviation, the heading counts as unknown and not as Gaussian
SPEED = 0.5  # m/s: converts noise of the odometry per second to noise per metre
METRES_PER_RADIAN = 0.5  # m: a turn by one radian takes as much time as driving this distance (1 rad/s, 0.5 m/s)


@dataclass(frozen=True, eq=False)
class Sensors:
    """The sensor models of a robot. They predict the information of measurements along a path.

    ``odometry``: the noise of the motion. ``forecasts``: one model for each sensor that observes objects in the map. It
    predicts the measurements. ``metres_per_radian`` [m]: the distance driven in the time of a turn by one radian.
    """

    odometry: OdometryModel
    forecasts: tuple[Forecast, ...] = ()
    metres_per_radian: float = METRES_PER_RADIAN

    @property
    def goals(self) -> Array:
        """Positions (K, 2) [m] near which the sensors are most informative, such as the positions of tags."""
        return np.concatenate([np.empty((0, 2)), *(forecast.goals for forecast in self.forecasts)])

    @staticmethod
    def of(
        world: World,
        rig: Rig,
        settings: Any,
        speed: float,
        turn_rate: float,
        only: Collection[str],
    ) -> Sensors:
        """Return the sensor models of a rig. ``only``: the names of the sensors that are used. ``settings``: the
        settings of the simulation, which have the rates of sensors. ``speed`` [m/s], ``turn_rate`` [rad/s]: of the
        robot."""
        made = [
            forecast(world, rig.alone(name), speed, settings)
            for name, forecast in functions("forecast", rig)
            if name in only
        ]
        # sensors with goals come first: the order affects the rounding of sums
        forecasts = sorted((f for f in made if f is not None), key=lambda f: not len(f.goals))
        return Sensors(odometry_model(rig, constants_as_noise=True), tuple(forecasts), speed / turn_rate)


def gaussian_entropy(covariance: Array, dims: int = POSE) -> Array:
    """Return the entropy (...) [nats] of Gaussians with ``covariance`` (..., 3, 3) of x, y and heading.

    ``dims``: the number of leading coordinates that are considered. Their covariance C gives the entropy ``log(det(2 pi
    e C)) / 2`` (Cover, Thomas, "Elements of Information Theory", 2006, theorem 8.4.1).
    """
    part = np.asarray(covariance)[..., :dims, :dims]
    return np.asarray(0.5 * (dims * math.log(2.0 * math.pi * math.e) + np.linalg.slogdet(part)[1]))


def particle_entropy(poses: Array, weights: Array, dims: int = POSE) -> float:
    """Return the entropy [nats] of a histogram of particles ``poses`` (M, 3) with ``weights`` (M,).

    ``dims``: the number of leading coordinates that are considered. The result is comparable with
    :func:`gaussian_entropy` if the belief is wider than a cell and there are more particles than cells.
    """
    even: Array32 = weights[None].astype(np.float32)
    at = np.ascontiguousarray(poses, dtype=float)[None]
    return float(_entropies(at, np.zeros(1, dtype=np.int64), even, dims, several=True)[0])


def has_several_modes(poses: Array, weights: Array) -> bool:
    """True if a Gaussian is a poor description of particles ``poses`` (M, 3) with ``weights`` (M,). Either their
    heading is unknown, or a Gaussian with their covariance has much more entropy (by :data:`SEVERAL`) than their
    histogram."""
    _, covariance = pose_moments(poses, weights)
    if covariance[2, 2] > WIDEST_HEADING**2:
        return True
    # a histogram spreads each particle over a cell: add that variance to the Gaussian's (Sheppard's correction)
    gaussian = gaussian_entropy(covariance + np.diag(CELL**2 / 12.0), POSITION)
    return bool(gaussian - particle_entropy(poses, weights, POSITION) > SEVERAL)


def expected_gain(
    sensors: Sensors,
    particles: Array,
    weights: Array,
    paths: Sequence[Path],
    rng: np.random.Generator,
    *,
    space: FreeSpace | None = None,
    places: NDArray[np.int64] | None = None,
    noise: OdometryModel | None = None,
    samples: int = SAMPLES,
    scans: int = SCANS,
) -> Array:
    """Return the expected reduction of entropy (C,) [nats] by the measurements on each of C ``paths``.

    ``sensors``: models of the sensors. ``particles`` (M, 3), ``weights`` (M,): the belief, in the world frame.
    ``space``: free space. A particle stops and measures nothing where its path leads into a wall. None means no walls.
    ``places`` (M,): the index of each particle's mode. If given, the entropy of this index is computed, otherwise the
    entropy of the pose at the end of the path. ``noise``: of the odometry, None for no noise. ``samples``: the number
    of particles to use. ``scans``: the number of these particles at which measurements are simulated.
    """
    if not paths:
        return np.empty(0)
    several = places is not None or has_several_modes(particles, weights)
    rows = rng.permutation(
        systematic(weights, rng, samples if len(particles) < FEWEST else min(samples, len(particles)))
    )
    poses = np.ascontiguousarray(particles[rows], dtype=float)
    # if modes are given, all particles of a mode are put into one cell of the histogram
    cells = None if places is None else np.multiply.outer(places[rows] + 0.5, (CELL[0], 0.0, 0.0))[None]
    count = len(poses)
    scans = min(scans, count)
    seed = np.uint64(rng.integers(2**63))
    passed = [path.passed(sensors.metres_per_radian) for path in paths]
    stations = [_stations(metres) for metres in passed]
    normals = rng.standard_normal((max(len(s) for s in stations), count, 3))
    last = np.full((len(paths), count), np.iinfo(np.int64).max) if space is None else free_steps(space, poses, paths)
    posterior = np.empty((len(paths), scans))
    even: Array32 = np.full((1, count), 1.0 / count, dtype=np.float32)
    start = poses[None] if cells is None else cells
    prior = _entropies(start, np.zeros(1, dtype=np.int64), even, POSE, several=several)[0]
    for c, (path, steps) in enumerate(zip(paths, stations, strict=True)):
        at = np.empty((len(steps), count, 3))
        sigmas = np.zeros((len(steps), 3)) if noise is None else _sigmas(path, steps, noise)
        particle_kernels.station_poses(poses, path.poses, steps, last[c], sigmas, normals, at)
        stops = np.searchsorted(steps[1:-1], last[c], side="right")
        log_weights: Array32 = np.zeros((scans, count), dtype=np.float32)
        for forecast in sensors.forecasts:
            forecast.add_log_weights(at[1:-1], float(passed[c][-1]), stops, seed, log_weights)
        log_weights -= log_weights.max(axis=1, keepdims=True)
        # the entropy at the end of the path, or at the last station if the robot stops before
        index = np.where(last[c, :scans] >= steps[-1], len(steps) - 1, stops[:scans])
        if cells is not None or (several and noise is None):
            # without noise, a motion does not change the distances between particles: use the entropy at the start
            index = np.zeros_like(index)
        weighed = at if cells is None else cells
        posterior[c] = _entropies(weighed, index, np.exp(log_weights), POSE, several=several)
    return np.asarray(prior - posterior.mean(axis=1))


def _entropies(poses: Array, index: Places, weights: Array32, dims: int, *, several: bool) -> Array:
    """Return J entropies (J,) [nats] of M particles. ``poses`` (S, M, 3): the particles at S stations. ``index`` (J,):
    the index of the station of each entropy. ``weights`` (J, M): the particles' weights for each entropy. ``dims``: the
    number of leading coordinates that are considered. ``several``: True to use a histogram, False to use a Gaussian."""
    if several:
        out = np.empty(len(index))
        particle_kernels.cell_entropies(poses, index, weights, CELL, dims, out)
        return out
    covariances = np.empty((len(index), 3, 3))
    particle_kernels.covariances(poses, index, weights, covariances)
    return gaussian_entropy(covariances + np.diag(FINEST**2), dims)


def _stations(passed: Array) -> Places:
    """Return the indices of stations among the poses of a path: the start, the poses of measurements, and the end.

    ``passed`` (S,) [m]: the distance up to each pose of the path. The path is divided into equal parts, and the
    measurements of each part are predicted in its middle.
    """
    count = min(max(1, round(passed[-1] / STATION_DISTANCE)), MOST_STATIONS)
    middles = (np.arange(count) + 0.5) * passed[-1] / count
    observations = np.searchsorted(passed, middles - 1e-9)
    return np.concatenate(([0], observations, [len(passed) - 1])).astype(np.int64)


def _sigmas(path: Path, steps: Places, noise: OdometryModel) -> Array:
    """Return the standard deviations (S, 3), in the robot frame, of the motion that leads to each of S stations. It is
    zero for the first. ``steps`` (S,): the indices of the stations among the poses of ``path``. ``noise``: of the
    odometry."""
    distance = np.diff(path.metres[steps])
    rotation = np.diff(path.turned[steps])
    out = np.zeros((len(steps), 3))
    for column, growth in enumerate((noise.along, noise.lateral, noise.heading)):
        out[1:, column] = np.sqrt(growth.per_distance**2 * distance + growth.per_rotation**2 * rotation)
    return out


def expected_covariance(mean: Array, covariance: Array, path: Path, sensors: Sensors) -> Array:
    """Return the expected covariance (3, 3) of x, y and heading in the world frame at the end of a path.

    ``mean`` (3,), ``covariance`` (3, 3): the belief at the start of the path, also in the world frame. ``sensors``: the
    sensor models, which predict measurements at each pose of the path except the first.
    """
    body = se2.world_to_body(mean, covariance)
    poses = se2.compose(mean, path.poses)
    passed = path.passed(sensors.metres_per_radian)
    by_pose: Array = np.zeros((len(poses) - 1, 3, 3))
    for forecast in sensors.forecasts:
        by_pose += forecast.information(poses[1:], np.diff(passed))
    columns = (path.metres.tolist(), path.poses.tolist(), path.turned.tolist())
    states = [
        ChainState(d / SPEED, x, y, heading, d, turn, 0.0) for d, (x, y, heading), turn in zip(*columns, strict=True)
    ]
    for (start, end), information in zip(pairwise(states), by_pose, strict=True):
        body = propagate(body, odometry.relative_motion(sensors.odometry, start, end))
        # the inverse of the sum of both information matrices, in a form that allows a singular covariance
        body = np.linalg.solve(np.eye(3) + body @ information, body)
        body = (body + body.T) / 2.0
    return se2.body_to_world(poses[-1], body)


def fisher_gain(mean: Array, covariance: Array, paths: Sequence[Path], sensors: Sensors) -> Array:
    """Return the expected reduction of entropy (C,) [nats] of a Gaussian belief on each of C paths. It is negative if
    the noise of the motion adds more entropy than the measurements remove.

    ``mean`` (3,), ``covariance`` (3, 3): the belief over (x, y, heading), in the world frame. ``sensors``: the sensor
    models. Reducing a standard deviation that is below :data:`~factorgraph_loc.planning.information.FINEST` gains
    almost nothing.
    """
    fine = np.diag(FINEST**2)
    entropies = [gaussian_entropy(expected_covariance(mean, covariance, path, sensors) + fine) for path in paths]
    return np.asarray(gaussian_entropy(covariance + fine) - np.array(entropies, dtype=float))

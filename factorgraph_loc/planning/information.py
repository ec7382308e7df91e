"""Expected information of a path: entropy of the belief, minus the mean entropy after the scans on the path.

``h[p(x)] - E_z h[p(x | z, a)]``, to be maximised. Scans are drawn from the antenna model at particles of the belief, all
particles are weighted by them, and the entropy is that of the weighted particles. All paths use the same particles and random
numbers, so that the differences between paths have less variance than the gains (common random numbers: Glasserman, Yao,
Management Science 38(6), 1992).

Entropies are differential, in nats: of a Gaussian with the particles' covariance for a unimodal belief, else of a histogram.

For a nearly known pose it is the Fisher information in closed form: a Gaussian belief is propagated along the path with the noise
of the odometry; at each station the expected information of the sensors at the mean is added (van Trees, "Detection, Estimation,
and Modulation Theory", part I, 1968, section 2.4: the Cramer-Rao bound). No measurement is drawn. It is valid while the sensor
models are nearly linear over the belief.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.fusion.cloud import pose_moments, systematic
from factorgraph_loc.maps.free_space import FreeSpace
from factorgraph_loc.planning import particle_kernels
from factorgraph_loc.planning.paths import Path, free_steps
from factorgraph_loc.planning.sensors import SPEED, Sensors
from factorgraph_loc.sensors.interfaces import Array32, Places
from factorgraph_loc.text import quoted
from factors import se2
from factors.motion import ChainState, propagate
from factors.odometry import model as odometry
from factors.odometry.model import OdometryModel
from factors.se2 import Array

DIMS = ("x", "y", "heading")
POSITION = ("x", "y")
CELL = np.array((0.5, 0.5, 2.0 * math.pi / 20.0))  # m, m, rad: cells of histograms; an integer number of headings
FINEST = np.array((0.1, 0.1, 0.05))  # m, m, rad: standard deviations below which nothing is gained
LOOK = 1.5  # m between stations; a station represents the rounds on that distance, or in turns of the same duration
LOOKS = 10  # maximum number of stations; on a longer path they are farther apart
SAMPLES, SCANS = 256, 48  # particles that are weighted, and those that scans are drawn from
FEWEST = 10  # least number of particles
SEVERAL = 0.5  # nats: largest difference of a unimodal belief's entropy from that of a Gaussian with its covariance
WIDEST_HEADING = 0.8  # rad: largest standard deviation of a Gaussian heading


def gaussian_entropy(covariance: Array, dims: Sequence[str] = DIMS) -> Array:
    """Entropy (...) [nats] of Gaussians with ``covariance`` (..., 3, 3) of x, y, heading, in the dimensions ``dims``: ``log(det(2
    pi e C)) / 2`` (Cover, Thomas, "Elements of Information Theory", 2006, theorem 8.4.1).
    """
    chosen = _columns(dims)
    part = np.asarray(covariance)[..., chosen, :][..., chosen]
    return np.asarray(0.5 * (len(chosen) * math.log(2.0 * math.pi * math.e) + np.linalg.slogdet(part)[1]))


def particle_entropy(poses: Array, weights: Array, dims: Sequence[str] = DIMS, cell: Array = CELL) -> Array:
    """Histogram entropy (...) [nats] of particles ``poses`` (M, 3) with ``weights`` (..., M), in the dimensions ``dims``.

    ``cell`` (3,) [m, m, rad]: size of the cells. Comparable with :func:`gaussian_entropy` for beliefs wider than a cell and more
    particles than cells.
    """
    chosen = _leading(dims)
    flat = np.atleast_2d(weights).reshape(-1, len(poses)).astype(np.float32)
    out = np.empty(len(flat))
    at = np.ascontiguousarray(poses, dtype=float)[None]
    particle_kernels.cell_entropies(at, np.zeros(len(flat), dtype=np.int64), flat, cell, chosen, out)
    return out.reshape(np.shape(weights)[:-1])


def has_several_modes(poses: Array, weights: Array) -> bool:
    """Whether particles (M, 3) with weights (M,) are poorly described by a Gaussian: the entropy of its position exceeds theirs
    by more than :data:`SEVERAL`, or the heading is unknown.
    """
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
    dims: Sequence[str] = POSITION,
    space: FreeSpace | None = None,
    places: NDArray[np.int64] | None = None,
    noise: OdometryModel | None = None,
    samples: int = SAMPLES,
    scans: int = SCANS,
) -> Array:
    """Expected reduction of entropy (C,) [nats] on each of C paths.

    The belief has particles (M, 3) in the world frame with weights (M,). The entropy afterwards is that of the pose at the end.
    ``dims``: position, or position and heading. ``space``: a particle whose path leads into a wall stops and measures no more.
    ``places`` (M,): the mode of each particle; the entropy is then that of the mode index. ``noise``: of the odometry on the path,
    none by default. ``samples``: number of particles that are weighted; ``scans`` of these draw measurements of all ``sensors``.
    """
    if not paths:
        return np.empty(0)
    chosen = _leading(dims)
    several = places is not None or has_several_modes(particles, weights)
    rows = rng.permutation(
        systematic(weights, rng, samples if len(particles) < FEWEST else min(samples, len(particles)))
    )
    poses = np.ascontiguousarray(particles[rows], dtype=float)
    # one cell per mode
    cells = None if places is None else np.multiply.outer(places[rows] + 0.5, (CELL[0], 0.0, 0.0))[None]
    count = len(poses)
    scans = min(scans, count)
    seed = np.uint64(rng.integers(2**63))
    passed = [path.passed(1.0, sensors.metres_per_radian) for path in paths]
    stations = [_stations(metres, LOOK) for metres in passed]
    normals = rng.standard_normal((max(len(s) for s in stations), count, 3))
    last = np.full((len(paths), count), np.iinfo(np.int64).max) if space is None else free_steps(space, poses, paths)
    posterior = np.empty((len(paths), scans))
    even: Array32 = np.full((1, count), 1.0 / count, dtype=np.float32)
    prior = _entropies(poses[None] if cells is None else cells, np.zeros(1, dtype=np.int64), even, chosen, several)[0]
    for c, (path, steps) in enumerate(zip(paths, stations, strict=True)):
        at = np.empty((len(steps), count, 3))
        sigmas = np.zeros((len(steps), 3)) if noise is None else _sigmas(path, steps, noise)
        particle_kernels.look_poses(poses, path.poses, steps, last[c], sigmas, normals, at)
        stops = np.searchsorted(steps[1:-1], last[c], side="right")
        log_weights: Array32 = np.zeros((scans, count), dtype=np.float32)
        for forecast in sensors.forecasts:
            forecast.add_log_weights(at[1:-1], float(passed[c][-1]), stops, seed, log_weights)
        log_weights -= log_weights.max(axis=1, keepdims=True)
        # a robot that reaches the end is there; a stopped one is near its last station
        index = np.where(last[c, :scans] >= steps[-1], len(steps) - 1, stops[:scans])
        if cells is not None or (several and noise is None):
            # the entropy at the end of the path, up to the alignment with the histogram's cells
            index = np.zeros_like(index)
        posterior[c] = _entropies(at if cells is None else cells, index, np.exp(log_weights), chosen, several)
    return np.asarray(prior - posterior.mean(axis=1))


def _columns(dims: Sequence[str]) -> list[int]:
    """Columns of a pose. Raises InputError for a wrong dimension."""
    if not dims:
        raise InputError(f"dims: are none, expected some of {', '.join(DIMS)}")
    for name in dims:
        if name not in DIMS:
            raise InputError(f"dims: is {quoted(name)}, expected some of {', '.join(DIMS)}")
    return sorted({DIMS.index(name) for name in dims})


def _leading(dims: Sequence[str]) -> int:
    """Number of leading coordinates in ``dims``. Raises InputError if there is a gap."""
    columns = _columns(dims)
    if columns != list(range(len(columns))):
        raise InputError(f"dims: are {', '.join(dims)}, expected x, y or x, y, heading")
    return len(columns)


def _entropies(poses: Array, index: Places, weights: Array32, dims: int, several: bool) -> Array:
    """Entropies (J,) of particles at stations ``index`` (J,) of ``poses`` (S, M, 3), with weights (J, M)."""
    if several:
        out = np.empty(len(index))
        particle_kernels.cell_entropies(poses, index, weights, CELL, dims, out)
        return out
    covariances = np.empty((len(index), 3, 3))
    particle_kernels.covariances(poses, index, weights, covariances)
    return gaussian_entropy(covariances + np.diag(FINEST**2), DIMS[:dims])


def _stations(passed: Array, each: float) -> Places:
    """Indices of the stations among the poses of a path, given the metres ``passed`` (S,): the start, the observations, each in
    the middle of about ``each`` metres, and the end.
    """
    count = min(max(1, round(passed[-1] / each)), LOOKS)
    middles = (np.arange(count) + 0.5) * passed[-1] / count
    observations = np.searchsorted(passed, middles - 1e-9)
    return np.concatenate(([0], observations, [len(passed) - 1])).astype(np.int64)


def _sigmas(path: Path, steps: Places, noise: OdometryModel) -> Array:
    """Standard deviations (S, 3) of the motion from one station to the next."""
    distance = np.diff(path.metres[steps])
    rotation = np.diff(path.turned[steps])
    out = np.zeros((len(steps), 3))
    for column, growth in enumerate((noise.along, noise.lateral, noise.heading)):
        out[1:, column] = np.sqrt(growth.per_distance**2 * distance + growth.per_rotation**2 * rotation)
    return out


def expected_covariance(mean: Array, covariance: Array, path: Path, sensors: Sensors) -> Array:
    """Expected covariance (3, 3) of x, y, heading in the world frame at the end of a path.

    ``mean`` (3,), ``covariance`` (3, 3): of the belief at its start. The robot observes at each pose of the path but the first.
    """
    body = se2.world_to_body(mean, covariance)
    poses = se2.compose(mean, path.poses)
    passed = path.passed(1.0, sensors.metres_per_radian)
    by_pose = expected_information(poses[1:], np.diff(passed), sensors)
    columns = (path.metres.tolist(), path.poses.tolist(), path.turned.tolist())
    states = [
        ChainState(d / SPEED, x, y, heading, d, turn, 0.0) for d, (x, y, heading), turn in zip(*columns, strict=True)
    ]
    for (start, end), information in zip(pairwise(states), by_pose, strict=True):
        body = propagate(body, odometry.relative_motion(sensors.odometry, start, end))
        # equals the inverse of the summed information, also for a singular covariance
        body = np.linalg.solve(np.eye(3) + body @ information, body)
        body = (body + body.T) / 2.0
    return se2.body_to_world(poses[-1], body)


def fisher_gain(
    mean: Array, covariance: Array, paths: Sequence[Path], sensors: Sensors, *, dims: Sequence[str] = POSITION
) -> Array:
    """Expected reduction of entropy (C,) [nats] on each of C paths, in the dimensions ``dims``; see :func:`expected_covariance`.
    Accuracy better than :data:`~factorgraph_loc.planning.information.FINEST` counts nothing.
    """
    fine = np.diag(FINEST**2)
    entropies = [gaussian_entropy(expected_covariance(mean, covariance, path, sensors) + fine, dims) for path in paths]
    return np.asarray(gaussian_entropy(covariance + fine, dims) - np.array(entropies, dtype=float))


def expected_information(poses: Array, lengths: Array, sensors: Sensors) -> Array:
    """Fisher information (N, 3, 3) on a body-frame perturbation of poses (N, 3), from all sensors, while driving
    ``lengths`` (N,) [m] around each pose, or turning for the same time.
    """
    out = np.zeros((len(poses), 3, 3))
    for forecast in sensors.forecasts:
        out += forecast.information(poses, lengths)
    return out

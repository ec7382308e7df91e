"""What would be seen of landmarks on the way, and how well it would agree with each particle: the part of landmarks in
:mod:`factorgraph_loc.planning.information`.

The sightings of one look are as one with the mean of all, of less noise. Landmarks that are not seen tell nothing.
"""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.planning.sensors import Sensors
from factorgraph_loc.sensors.landmarks.simulation import in_sight
from factorgraph_loc.sensors.rfid.forecast import Array32, Places
from factors.landmarks import model as bearing_range
from factors.se2 import Array


def add_log_weights(sensors: Sensors, poses: Array, looks: float, stops: Places, seed: np.uint64, out: Array32) -> None:
    """Add to ``out`` (J, M) what the sightings that the first J particles might make on one path tell of each of M.

    ``poses`` (S, M, 3): where they look; ``looks``: how often at each; ``stops`` (J,): at how many of the places each gets to look.
    Draws are the same for all paths of one ``seed``.
    """
    model = sensors.bearing_range
    assert model is not None, "landmarks are seen"
    points = sensors.world.positions()
    scans = len(stops)
    for s in range(len(poses)):
        j, k = in_sight(model, sensors.world, poses[s, :scans], sensors.sightings)
        looking = s < stops[j]
        j, k = j[looking], k[looking]
        if not len(j):
            continue
        ranges, bearings = bearing_range.predict(model, poses[s][:, None], points[None])
        sigmas = bearing_range.sigmas(model, ranges[j, k]) / math.sqrt(looks)
        normals = np.random.default_rng((int(seed), s)).standard_normal((scans, len(points), 2))
        noise = sigmas * normals[j, k]
        measured = np.column_stack((ranges[j, k] + noise[:, 0], bearings[j, k] + noise[:, 1]))
        _add(ranges, bearings, measured, sigmas, j, k, out)


@numba.njit(cache=True)
def _add(
    ranges: Array,
    bearings: Array,
    measured: Array,
    sigmas: Array,
    scans: NDArray[np.int64],
    landmarks: NDArray[np.int64],
    out: Array32,
) -> None:
    for n in range(len(scans)):
        j, k = scans[n], landmarks[n]
        for i in range(len(ranges)):
            along = (ranges[i, k] - measured[n, 0]) / sigmas[n, 0]
            turn = bearings[i, k] - measured[n, 1]
            turn -= 2.0 * np.pi * np.floor(turn / (2.0 * np.pi) + 0.5)
            across = turn / sigmas[n, 1]
            out[j, i] -= np.float32(0.5 * (along * along + across * across))

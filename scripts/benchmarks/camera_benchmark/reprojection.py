"""Reprojection of known points from poses in space."""

from __future__ import annotations

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.model.trajectory3 import Trajectory3
from factorgraph_loc.sensors.camera.stream import SightingStream
from factors.camera.model import linearize_in_space, mounted
from factors.se2 import Array


def reprojection_residuals(found: Trajectory3, log: Log, sensor: str = "sightings") -> Array:
    """Measured minus predicted pixels (K, 2) of the map points that a camera names.

    ``sensor``: ``sightings`` or ``sightings_right``. Points that the map lacks, and sightings before or after the trajectory, are
    omitted.
    """
    stream = log.streams[sensor]
    settings = log.rig.camera if sensor == "sightings" else log.rig.camera_right
    assert isinstance(stream, SightingStream)
    assert settings is not None
    assert log.world.points is not None
    model, points, t = settings.model(), log.world.points, stream.t + settings.time_offset
    known = np.array([name in points.index for name in stream.point], dtype=bool)
    rows = np.flatnonzero(known & (t >= found.t[0]) & (t <= found.t[-1]))
    times, which = np.unique(t[rows], return_inverse=True)
    poses = found.at(times)
    out = np.empty((len(rows), 2))
    for k in range(len(times)):
        here = np.flatnonzero(which == k)
        seen = points.positions[[points.index[stream.point[i]] for i in rows[here].tolist()]]
        out[here] = -linearize_in_space(model, *mounted(model, poses.positions[k], poses.rotations[k]), seen)[0]
    return out + np.column_stack((stream.u[rows], stream.v[rows]))


def spread_of(residuals: Array) -> dict[str, float]:
    """Median absolute value and root mean square [px] of residuals (K, 2), by coordinate."""
    figures = {}
    for i, axis in enumerate("uv"):
        figures[f"{axis}_mad"] = float(np.median(np.abs(residuals[:, i])))
        figures[f"{axis}_rms"] = float(np.sqrt(np.mean(residuals[:, i] ** 2)))
    return figures


def common_to_images(residuals: Array, t: Array) -> Array:
    """Correlation (2,) of the residuals (K, 2) of different points in one image, by coordinate; ``t`` (K,): of the images."""
    _, which = np.unique(t, return_inverse=True)
    sums = np.array([np.bincount(which, axis) for axis in residuals.T])
    pairs = np.sum(np.bincount(which).astype(float) ** 2) - len(t)
    square = np.sum(residuals**2, axis=0)
    return np.asarray((np.sum(sums**2, axis=1) - square) / pairs / (square / len(t)))

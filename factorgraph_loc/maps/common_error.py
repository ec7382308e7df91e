"""The common error of all points of a map near a place, if the map was made without a reference.

Such a map is bent as the drive's trajectory was. A robot that is localized in it has the same error, with any number of points: it
does not average out, unlike the points' own errors. It is therefore not part of an image's noise, but is added to the covariance in
the frame of the map. It is the error of the drive's pose at the observation of the points, moved to the robot as a rigid body.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factorgraph_loc.maps.points import PointMap
from factors.se2 import Array

ARM = 1.0  # m: distance that is equivalent to a turn of 1 rad, to choose the nearest place
LEAST = 0.01  # m: least standard deviation of a point without the common error


@dataclass(frozen=True, eq=False)
class CommonError:
    """``covariances`` (K, 3, 3) of (x, y, heading) about ``places`` (K, 2) [m] of the camera.

    ``directions`` (K, 2): unit vectors from the camera to the points.
    """

    places: Array
    directions: Array
    covariances: Array

    @classmethod
    def of(cls, points: PointMap) -> CommonError | None:
        """That of a map; None if it was made with a reference."""
        if points.common is None or not len(points.owners):
            return None
        places, first, of = np.unique(points.seen_from[:, :2], axis=0, return_index=True, return_inverse=True)
        rays = points.positions[points.owners, :2] - points.seen_from[:, :2]
        directions = np.zeros_like(places)
        np.add.at(directions, of.ravel(), _unit(rays))
        return cls(places, _unit(directions), points.common[first])

    def at(self, poses: Array, looking: float = 0.0) -> Array:
        """The covariances (N, 3, 3) at ``poses`` (N, 3) of a robot: those of the nearest places with a similar view.

        ``looking`` [rad]: direction of the camera in the robot frame.
        """
        ahead = poses[:, 2] + looking
        cosine = np.column_stack((np.cos(ahead), np.sin(ahead))) @ self.directions.T
        away = np.linalg.norm(poses[:, None, :2] - self.places, axis=2)
        nearest = np.hypot(away, ARM * np.arccos(np.clip(cosine, -1.0, 1.0))).argmin(axis=1)
        return carried(self.covariances[nearest], poses[:, :2] - self.places[nearest])


def carried(covariances: Array, arms: Array) -> Array:
    """``covariances`` (N, 3, 3) of a rigid body's (x, y, heading), moved to points at ``arms`` (N, 2) [m] from the old ones."""
    lever = np.repeat(np.eye(3)[None], len(arms), axis=0)
    lever[:, 0, 2], lever[:, 1, 2] = -arms[:, 1], arms[:, 0]
    return np.asarray(lever @ covariances @ lever.transpose(0, 2, 1))


def without_common(points: PointMap) -> PointMap:
    """The map with covariances of its points without their common error."""
    if points.common is None:
        return points
    moved = carried(points.common, points.positions[points.owners, :2] - points.seen_from[:, :2])[:, :2, :2]
    order = np.argsort(-np.trace(moved, axis1=1, axis2=2), kind="stable")
    shared = np.zeros_like(points.covariances)
    shared[points.owners[order], :2, :2] = moved[order]  # of the view that has least in common with others
    values, axes = np.linalg.eigh(points.covariances - shared)
    own = (axes * np.maximum(values, LEAST**2)[:, None, :]) @ axes.transpose(0, 2, 1)
    return replace(points, covariances=own)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9))

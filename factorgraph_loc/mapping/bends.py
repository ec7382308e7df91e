"""Bends of a reference against the rigid map that was made with it.

Errors of a reference vary slowly from place to place, as those of a dense reconstruction or of odometry do, while a map is
rigid. So the images that made the map are located in it; what they are off from their reference is interpolated by the distance
of camera poses (kernel regression: Nadaraya, "On estimating regression", 1964), and tells how far it can be believed: the errors of
each from the others, which grow as a random walk.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_loc.mapping.image_localization import Located
from factorgraph_loc.mapping.triangulation import Cameras
from factors.se2 import Array

ARM = 0.8  # m that a turn of 1 rad counts as
NOTHING_KNOWN = 0.1  # weight of no bend, where that of a camera at the place is 1
NARROWEST = 0.01  # m, the least reach
ASTRAY = 0.1  # m or rad: images that are farther off were located wrongly


@dataclass(frozen=True, eq=False)
class Bends:
    """``errors`` (F, 6) of ``cameras`` of a reference, as located in the map: rotation and translation in their own frames.

    ``reach`` [m]: of interpolation. ``growth`` (6, 6): covariance per metre of distance from the nearest camera.
    """

    cameras: Cameras
    errors: Array
    reach: float
    growth: Array

    @staticmethod
    def of(cameras: Cameras, places: Sequence[Located | None]) -> Bends:
        """The bends of ``cameras`` (F), from where their images were located; none if fewer than two were."""
        pairs = [(i, place) for i, place in enumerate(places) if place is not None]
        errors = np.array([_error(cameras.positions[i], cameras.rotations[i], place) for i, place in pairs]).reshape(
            -1, 6
        )
        good = np.abs(errors).max(axis=1, initial=0.0) < ASTRAY
        if np.count_nonzero(good) < 2:
            good[:] = False
        cameras = cameras[np.array([i for i, _ in pairs], dtype=np.int64)[good]]
        found = Bends(cameras, errors[good], NARROWEST, np.zeros((6, 6)))
        if not len(cameras):
            return found
        apart = np.array([found._distances(p, r) for p, r in zip(cameras.positions, cameras.rotations, strict=True)])
        np.fill_diagonal(apart, np.inf)
        nearest = np.maximum(apart.min(axis=1), NARROWEST)
        found = replace(found, reach=float(np.median(nearest)))
        left = (found.errors - found._interpolated(apart)) / np.sqrt(np.maximum(nearest, found.reach))[:, None]
        return replace(found, growth=left.T @ left / len(left))

    def in_reference(self, place: Located | None) -> Located | None:
        """A place in the map, as a place in the reference, with the uncertainty of the bends."""
        if place is None or not len(self.cameras):
            return place
        apart = self._distances(place.position, place.rotation)
        bend = self._interpolated(apart[None])[0]
        return replace(
            place,
            position=place.position - place.rotation @ bend[3:],
            rotation=place.rotation @ Rotation.from_rotvec(-bend[:3]).as_matrix(),
            covariance=place.covariance + self._spread(place),
        )

    def combined(self, alone: Located | None, together: Located | None) -> Located | None:
        """Where an image is in the map: located ``alone``, or ``together`` with others.

        The map is bent as the reference is, which an image alone follows, but not the rigid motion from image to image, so that all
        images have the same error. So what is not known of the bends is the uncertainty of the latter, and both are averaged
        accordingly. Where they contradict each other, one is wrong: that with which fewer points of the map agree.
        """
        if alone is None or together is None:
            return together or alone
        apart = _error(together.position, together.rotation, alone)
        if np.abs(apart).max() > ASTRAY:
            return max(together, alone, key=lambda place: len(place.points))
        spread = self._spread(alone)
        gain = spread @ np.linalg.inv(spread + alone.covariance)
        rest = np.eye(6) - gain
        step = gain @ apart
        return replace(
            together,
            position=together.position + alone.rotation @ step[3:],
            rotation=together.rotation @ Rotation.from_rotvec(step[:3]).as_matrix(),
            covariance=rest @ together.covariance @ rest.T + gain @ alone.covariance @ gain.T,
        )

    def _spread(self, place: Located) -> Array:
        """The covariance (6, 6) of what the bends of a place differ by from those of the nearest camera."""
        if not len(self.cameras):
            return np.zeros((6, 6))
        nearest = float(self._distances(place.position, place.rotation).min())
        return max(nearest, self.reach) * self.growth

    def _interpolated(self, apart: Array) -> Array:
        """The errors (N, 6) at distances (N, F) from the cameras."""
        weights = np.exp(-0.5 * (apart / self.reach) ** 2)
        return np.asarray(weights @ self.errors / (weights.sum(axis=1, keepdims=True) + NOTHING_KNOWN))

    def _distances(self, position: Array, rotation: Array) -> Array:
        """The distances (F,) [m] of a camera pose from the cameras, in position and rotation."""
        cosine = (np.einsum("nij,ij->n", self.cameras.rotations, rotation) - 1.0) / 2.0
        turn = np.arccos(np.clip(cosine, -1.0, 1.0))
        return np.asarray(np.hypot(np.linalg.norm(self.cameras.positions - position, axis=1), ARM * turn))


def _error(position: Array, rotation: Array, found: Located) -> Array:
    """The perturbation (6,) from a pose to another, rotation first, in the frame of the latter."""
    turn = Rotation.from_matrix(rotation.T @ found.rotation).as_rotvec()
    return np.concatenate((turn, found.rotation.T @ (found.position - position)))

"""Detection of feature tracks on moving objects, such as people, by comparison with the wheel odometry.

The odometry predicts the pixel of a static point, up to the unknown distance of the point. Tracks that do not fit this
prediction may be on a moving object. Images up to :data:`MAX_TIME` apart are compared, because a moving object may
agree with the odometry for a short time.

A slip of the wheels also makes tracks disagree with the odometry. In this case all static points move in the image as
if the robot had turned by another angle. The tracks that happen to agree with the odometry then agree with this other
turn, too. But if some tracks agree with the odometry and not with the other turn, the disagreeing tracks belong to a
moving object. This holds even if they are the majority.
"""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from factorgraph_loc.fusion.graph.graph import Graph, Keyframe
from factorgraph_loc.sensors.camera.known_points import lifted
from factorgraph_loc.vision.consensus import GATE, Truths
from factors import positive
from factors.camera.model import CameraModel, linearize_in_space, rays
from factors.camera.triangulation_kernels import inverse_depths
from factors.motion import Increment
from factors.se2 import Array

MAX_TIME = 2.0  # s between two images that are compared
ENOUGH = 8  # least number of tracks that agree with the odometry but not with another rotation of the robot
EXPLAINED = 0.8  # another rotation must explain this fraction of the tracks that disagree with the odometry
# rad: additional rotations of the robot that are tried to explain tracks, and the standard deviation of such a rotation
TURNS, TURN_SIGMA = np.linspace(-0.6, 0.6, 61), 0.01
FARTHEST, NEAREST, DISTANCES = 100.0, 0.5, 2  # m: bounds of a point's distance; number of distances that are tried


class MovingThings:
    """Classifies feature tracks as static or moving, from the images of the last :data:`MAX_TIME` seconds. ``moving``:
    the names of the tracks on moving objects."""

    def __init__(self, model: CameraModel) -> None:
        self._model = model
        self._images: list[tuple[Keyframe, Mapping[Hashable, Array]]] = []
        self.moving: set[Hashable] = set()
        self._steady: set[Hashable] = set()  # tracks that agreed with the odometry
        self._doubts = False  # True while the newest image has tracks on moving objects

    def is_static(self, name: Hashable) -> bool:
        """Return True if the feature track ``name`` is not known to be on a moving object. While the newest image shows
        moving objects, the track must also have agreed with the odometry once."""
        return name not in self.moving and (not self._doubts or name in self._steady)

    def learn(self, keyframe: Keyframe, names: Sequence[Hashable], pixels: Array, graph: Graph) -> None:
        """Update the classification with a new image. ``keyframe``: the keyframe of the image. ``names``: the names of
        its K feature tracks. ``pixels`` (K, 2): their pixels. ``graph``: supplies the odometry between keyframes."""
        new_pixels = dict(zip(names, pixels, strict=True))
        self._images = [image for image in self._images if image[0].t >= keyframe.t - MAX_TIME]
        for old_keyframe, old_pixels in reversed(self._images):
            if old_keyframe.t < keyframe.t:
                self._compare(old_pixels, new_pixels, graph.between(old_keyframe, keyframe))
        self._images.append((keyframe, new_pixels))
        known = set[Hashable]().union(*(pixels_by_name for _, pixels_by_name in self._images))
        self.moving &= known
        self._steady &= known
        self._doubts = not self.moving.isdisjoint(names)

    def _compare(self, old: Mapping[Hashable, Array], new: Mapping[Hashable, Array], step: Increment) -> None:
        """Update the classification with two images. ``old``, ``new``: {name of a track: its pixel} in the images.
        ``step``: the motion between the images by odometry."""
        common = [name for name in new if name in old]
        if not common:
            return
        first, second = (np.array([by_name[name] for name in common]) for by_name in (old, new))
        right = fitting(self._model, first, second, step)
        with_other_turn = another(self._model, first, second, step, right)
        known = np.array([name in self.moving for name in common])
        many = 2 * np.count_nonzero(known & ~right) > np.count_nonzero(~right)
        moves = with_other_turn.any() and (many or np.count_nonzero(right & ~with_other_turn) >= ENOUGH)
        self._steady.update(name for name, fits in zip(common, right.tolist(), strict=True) if fits)
        if moves:
            self.moving.update(name for name, fits in zip(common, right.tolist(), strict=True) if not fits)


def another(model: CameraModel, first: Array, second: Array, step: Increment, right: Truths) -> Truths:
    """Return a mask (K,) of the feature tracks that fit another rotation of the robot than the odometry's. The rotation
    is the one that explains the most tracks that disagree with the odometry.

    ``first``, ``second`` (K, 2): the pixels of K tracks in two images. ``step``: the motion between the images by
    odometry. ``right`` (K,): mask of the tracks that agree with ``step``. The mask is False everywhere in two cases.
    Most tracks agree with ``step``. Or the rotation explains less than the fraction :data:`EXPLAINED` of the other
    tracks.
    """
    best, unexplained = right, ~right
    if 2 * np.count_nonzero(unexplained) >= len(right):
        for turn in TURNS.tolist():
            delta, covariance = step.delta.copy(), step.covariance.copy()
            delta[2] += turn
            covariance[2, 2] += TURN_SIGMA**2
            fits = fitting(model, first, second, replace(step, delta=delta, covariance=covariance))
            if np.count_nonzero(fits & unexplained) > np.count_nonzero(best & unexplained):
                best = fits
    explained = np.count_nonzero(best & unexplained)
    enough = explained > 0 and explained >= EXPLAINED * np.count_nonzero(unexplained)
    return best if enough else np.zeros(len(right), dtype=bool)


def fitting(model: CameraModel, first: Array, second: Array, step: Increment) -> Truths:
    """Return a mask (K,) of the feature tracks that fit the motion ``step`` of the robot.

    ``first``, ``second`` (K, 2): the pixels of K tracks before and after the motion. A track fits if its second pixel
    is near the prediction for one of two distances of the object. The first distance brings the two rays nearest to
    each other. The second is a Gauss-Newton step from there, which considers the covariance of the motion.
    """
    first_rays, second_rays = (rays(model, pixels) @ model.rotation.T for pixels in (first, second))
    camera = lifted(model, step.delta, step.covariance)
    nearer = inverse_depths(first_rays, second_rays, model.position, step.delta)
    squared = np.full(len(first), np.inf)
    for _ in range(DISTANCES):
        nearer = np.clip(nearer, 1.0 / FARTHEST, 1.0 / NEAREST)
        points = model.position + first_rays / nearer[:, None]
        projected, by_camera, by_point = linearize_in_space(model, camera.position, camera.rotation, points)
        noise = by_camera @ camera.covariance @ by_camera.transpose(0, 2, 1) + 2.0 * model.sigma**2 * np.eye(2)
        squared = np.minimum(squared, positive.squared(projected - second, noise))
        by_nearness = -np.einsum("kij,kj->ki", by_point, first_rays) / nearer[:, None] ** 2
        weighted = np.linalg.solve(noise, by_nearness[..., None])[..., 0]
        nearer = nearer + np.einsum("ki,ki->k", weighted, second - projected) / np.einsum(
            "ki,ki->k", weighted, by_nearness
        )
    return np.asarray(squared < GATE)

"""Data association of the monoSLAM filter: matching of pixels of an image with points of the map or of the state.

Active search: a point of the state is searched in the 99 % ellipse of its innovation (Davison et al., 2007, see
:mod:`~factorgraph_loc.slam.monoslam_motion`, section III.E). Outliers are rejected by consensus: each single match
corrects the prediction, and the correction that most other matches agree with defines the inliers (Civera, Grasa,
Davison, Montiel, "1-Point RANSAC for EKF filtering", Journal of Field Robotics 27(5), 2010). The corrected pixels are
computed from the innovation covariance. This is fast enough to try all matches, not a random sample. Finally each
inlier is predicted from all other inliers. It is rejected if it is outside the gate of this prediction.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from factorgraph_loc.maps.points import PointMap, without_common
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.setup import MapUse, Setup
from factorgraph_loc.sensors.camera.known_points import DISAGREES, EXACT, MOST
from factorgraph_loc.sensors.camera.measurement import Pixels
from factorgraph_loc.slam.monoslam_state import Eye, Innovation, Sights, SlamState, squared
from factorgraph_loc.slam.slipping import ENOUGH, more_probable
from factorgraph_loc.vision import consensus
from factorgraph_loc.vision.association import Associator
from factorgraph_loc.vision.consensus import FEWEST, CameraPose, Truths
from factorgraph_loc.vision.frame import CameraFrame
from factorgraph_loc.vision.keypoints import spread_out
from factorgraph_loc.vision.matching import gates, match
from factorgraph_loc.vision.relocalization import located
from factors.camera import inverse_depth
from factors.camera.model import PLANAR
from factors.se2 import Array, Integers
from factors.update import GATE

CLEARANCE = 15.0  # px: smallest distance in the image between a new point and all other points
FEWEST_FOUND, SHARE_FOUND = 5, 0.5  # least number and fraction of inliers, to relocalize by points with names
FEWEST_MATCHES = 3  # with fewer matches, none is rejected


def agreeing(residual: Array, innovation: Innovation, noise: Array) -> Truths:
    """Return a mask (K,) of the matches that are inliers. If K is below :data:`FEWEST_MATCHES`, all are inliers.

    ``residual`` (K, 2) [px]: measured minus predicted pixels. ``innovation``: the covariance of the predicted pixels.
    ``noise`` (K, 2, 2) [px^2]: the covariances of the pixel noise.
    """
    count = len(residual)
    right = np.ones(count, dtype=bool)
    if count < FEWEST_MATCHES:
        return right
    total = innovation.total(noise)
    if _confirmed(residual, total, right).all():
        return right
    blocks = innovation.covariance.reshape(count, 2, count, 2).transpose(0, 2, 1, 3)  # (of j, by i)
    each = innovation.each(noise)
    gains = blocks @ np.linalg.inv(each)[None]
    corrected = residual[:, None] - np.einsum("jiab,ib->jia", gains, residual)
    covariances = each[:, None] - gains @ blocks.transpose(0, 1, 3, 2)
    # without rounding errors, the variances are at least as large as the noise
    covariances[..., 0, 0] = np.maximum(covariances[..., 0, 0], noise[:, None, 0, 0])
    covariances[..., 1, 1] = np.maximum(covariances[..., 1, 1], noise[:, None, 1, 1])
    distances = squared(corrected.reshape(-1, 2), covariances.reshape(-1, 2, 2)).reshape(count, count)
    i = np.arange(count)
    distances[i, i], covariances[i, i] = squared(residual, each), each
    inside = distances < GATE
    # an agreeing point with a large variance has a low score, because it agrees with any correction
    information = np.log(np.linalg.det(each)[:, None] / np.linalg.det(covariances))
    best = int(np.argmax(np.where(inside, GATE - distances + information, 0.0).sum(axis=0)))
    return _confirmed(residual, total, inside[:, best])


def _confirmed(residual: Array, total: Array, right: Truths) -> Truths:
    """Return a mask (K,) of inliers: ``right`` (K,) with outliers set to False, one at a time, the worst first.

    An outlier contradicts the pixel predicted from the remaining matches. ``residual`` (K, 2): measured minus predicted
    pixels. ``total`` (2K, 2K): the innovation covariance with noise.
    """
    rows = np.flatnonzero(right)
    count = len(rows)
    values = (2 * rows[:, None] + np.arange(2)).ravel()
    information, pixels = np.linalg.inv(total[np.ix_(values, values)]), residual[rows].ravel()
    while count >= FEWEST_MATCHES:
        i = np.arange(count)
        own = np.linalg.inv(information.reshape(count, 2, count, 2)[i, :, i, :])
        off = own @ (information @ pixels).reshape(count, 2, 1)  # relative to this prediction
        distances = squared(off[..., 0], own)
        worst = int(np.argmax(distances))
        if distances[worst] < GATE:
            break
        kept = np.repeat(i != worst, 2)
        cross = information[np.ix_(kept, ~kept)]
        information = information[np.ix_(kept, kept)] - cross @ own[worst] @ cross.T
        rows, pixels, count = np.delete(rows, worst), pixels[kept], count - 1
    confirmed = np.zeros(len(right), dtype=bool)
    confirmed[rows] = True
    return confirmed


@dataclass(frozen=True)
class Match:
    """The inlier matches of an image: M points of the filter's state, then P points of the known map.

    ``pixels`` (M + P, 2): the matched pixels. ``mapped``: indices of the M points of the state. ``points`` (P, 3):
    positions of the P points of the map. ``covariances`` (P, 3, 3): of these positions, None if negligible. ``taken``:
    indices of the matched pixels in the image. ``expected``: indices of the points of the state that should be matched.
    ``wanted``: number of map points that should be matched, 0 if they are too few to decide that the pose is lost.
    ``tempering``: the exponent of the likelihood of map points, at most 1, because their errors are correlated.
    """

    pixels: Array
    mapped: tuple[int, ...]
    points: Array
    covariances: Array | None
    taken: frozenset[int]
    expected: tuple[int, ...]
    wanted: int
    tempering: float = 1.0


class FeatureMatcher:
    """Matches the pixels of an image with points of the map and of the filter's state. ``use``: the points to match.
    "known" are points of the map only, "unknown" points of the state only, "extended" both."""

    def __init__(self, setup: Setup, diagnostics: Diagnostics, use: MapUse) -> None:
        self._diagnostics = diagnostics
        sensors, rig = setup.sensors, setup.rig
        used = "camera" in sensors or "sightings" in sensors
        self.eye = Eye.of(rig.camera.model()) if used and rig.camera else None  # the camera; None if the run uses none
        self._grows = use != "known"
        nothing = PointMap.of((), np.empty((0, 3)))
        known = nothing if use == "unknown" or setup.world.points is None else setup.world.points
        self._map = without_common(known)
        self._associator: Associator | None = None
        if self.eye is not None and "camera" in sensors and len(self._map.owners):
            self._associator = Associator(self._map, self.eye.model)
        self._has_uncertain_points = False
        if self.eye is not None and len(self._map):
            worst = float(np.trace(self._map.covariances, axis1=1, axis2=2).max())
            self._has_uncertain_points = worst > (EXACT * self.eye.model.sigma / self.eye.model.fx) ** 2

    def match(self, m: Pixels, state: SlamState, eye: Eye) -> Match:
        """Return the matches of the measurement ``m`` at the predicted ``state``. ``eye``: the camera. Outliers are
        removed and counted as rejected."""
        return self._named(m, m.names, state, eye) if m.frame is None else self._searched(m.frame, state, eye)

    def unless_slipped(
        self, m: Pixels, state: SlamState, eye: Eye, added: Array, rarity: float
    ) -> tuple[SlamState, Match]:
        """Return the result of :meth:`match`, after ``state``. If the wheels slipped, the returned state has a larger
        covariance.

        ``added`` (3, 3): the covariance of x, y and heading that slip adds. ``rarity``: minus the logarithm of the
        probability of slip. The wheels slipped if the log-likelihood ratio of the pixels exceeds ``rarity``.
        """
        slipped, diagnostics = state.widened(added), self._diagnostics
        added_before, noted = diagnostics.added, diagnostics.record()
        match = self.match(m, slipped, eye)
        diagnostics.added = added_before
        if len(match.pixels) >= ENOUGH and _slip(match, state, eye, added) > rarity:
            if added_before is not None:
                added_before += noted
            return slipped, match
        diagnostics.take_back(noted)
        return state, self.match(m, state, eye)

    def new(self, m: Pixels, state: SlamState, eye: Eye, match: Match, tracks: frozenset[int]) -> list[int]:
        """Return the indices of features or named pixels of the image ``m`` that may become new points of the state.

        A feature qualifies if it is not matched, belongs to one of the feature ``tracks``, and is far from matched and
        predicted pixels. A named pixel qualifies if its name is neither in the map nor in the state.
        """
        if m.frame is None:
            known_names = {p.name for p in state.points}
            return [i for i, name in enumerate(m.names) if i not in match.taken and name not in known_names]
        followed = np.isin(m.frame.tracks, list(tracks))
        expected = eye.mapped(state, range(len(state.points))).pixels
        occupied = np.concatenate((m.pixels[list(match.taken)].reshape(-1, 2), expected))
        chosen: list[int] = []
        for i in np.flatnonzero(followed).tolist():
            if not len(occupied) or np.abs(occupied - m.pixels[i]).max(axis=1).min() > CLEARANCE:
                chosen.append(i)
                occupied = np.concatenate((occupied, m.pixels[None, i]))
        return chosen

    def in_view(self, state: SlamState, eye: Eye, since: float) -> int:
        """Return the number of points of the state that should be visible, and were matched since ``since`` [s]."""
        lately = [i for i, p in enumerate(state.points) if p.t >= since]
        return len(_visible(eye, eye.mapped(state, lately))[1])

    def _named(self, m: Pixels, names: Sequence[str], state: SlamState, eye: Eye) -> Match:
        index = {p.name: i for i, p in enumerate(state.points)}
        ours = [(i, index[name]) for i, name in enumerate(names) if name in index]
        known = [(i, self._map.index[name]) for i, name in enumerate(names) if name in self._map.index]
        if not self._grows and (unknown := len(names) - len(known)):
            self._diagnostics.ignore("point not in the map", unknown)
        taken = frozenset(i for i, _ in (*ours, *known))
        right = self._agreeing(m.pixels, ours, state, eye)
        match = self._match(
            m.pixels, right, self._agreeing_known(m.pixels, known, state, eye), [i for _, i in ours], len(known)
        )
        return replace(match, taken=taken)

    def _searched(self, m: CameraFrame, state: SlamState, eye: Eye) -> Match:
        which = [i for i, p in enumerate(state.points) if p.descriptor is not None]
        sights, inside = _visible(eye, eye.mapped(state, which))
        which = [which[i] for i in inside.tolist()]
        ours = []
        if which:
            descriptors = np.array([state.points[i].descriptor for i in which])
            covariances = Innovation.of(sights, state.covariance).each(sights.noise)
            matches = match(descriptors, m.descriptors, allowed=gates(sights.pixels, covariances, m.pixels))
            ours = [(feature, which[row]) for row, feature in matches.indices.tolist()]
        known, wanted = self._known(m, state, eye)
        ours = self._agreeing(m.pixels, ours, state, eye)
        in_map = {f for f, _ in known}
        outside = [pair for pair in ours if pair[0] not in in_map]
        return replace(self._match(m.pixels, outside, known, which, wanted), tempering=eye.model.tempering)

    def relocated(self, m: Pixels, eye: Eye) -> CameraPose | None:
        """Return the camera pose, computed only from the image ``m`` and the map. Returns None if image and map do not
        determine it. ``eye``: the camera."""
        if m.frame is not None:
            relocated = None if self._associator is None else self._associator.relocalized(m.frame)
            return None if relocated is None else relocated[0]
        known = [(i, self._map.index[name]) for i, name in enumerate(m.names) if name in self._map.index]
        if len(known) < FEWEST_FOUND:
            return None
        rows, points = (list(part) for part in zip(*known, strict=True))
        place = located(eye.model, self._map.positions[points], m.pixels[rows], self._map.covariances[points])
        if place is None or np.count_nonzero(place.inliers) < max(FEWEST_FOUND, SHARE_FOUND * len(known)):
            return None
        return place.camera

    def _known(self, m: CameraFrame, state: SlamState, eye: Eye) -> tuple[list[tuple[int, int]], int]:
        """Return matching pairs (index of a feature, index of a map point), and the number of pairs to expect. ``m``:
        the features of the image. ``state``: the predicted state. ``eye``: the camera."""
        if self._associator is None:
            if not self._grows:
                self._diagnostics.ignore("camera", len(m.pixels))
            return [], 0
        if m.feature != self._associator.feature:
            self._diagnostics.ignore("camera: features of another kind than the map's", len(m.pixels))
            return [], 0
        associations = self._associator.guided(m, eye.predicted(state))
        if associations.rejected:
            self._diagnostics.reject(DISAGREES, associations.rejected)
        # if new points are added, keep outlier matches too, so that a feature that matches the map does not become a new point
        chosen = spread_out(m.pixels[associations.features], len(associations) if self._grows else MOST)
        return list(
            zip(associations.features[chosen].tolist(), associations.points[chosen].tolist(), strict=True)
        ), associations.expected

    def _agreeing(
        self, pixels: Array, ours: list[tuple[int, int]], state: SlamState, eye: Eye
    ) -> list[tuple[int, int]]:
        """Return the inliers among the pairs ``ours`` (index in ``pixels``, index of a point of the state). ``state``:
        the predicted state. ``eye``: the camera."""
        if not ours:
            return ours
        sights = eye.mapped(state, [p for _, p in ours])
        residual = pixels[[i for i, _ in ours]] - sights.pixels
        return self._kept(ours, agreeing(residual, Innovation.of(sights, state.covariance), sights.noise))

    def _agreeing_known(
        self, pixels: Array, known: list[tuple[int, int]], state: SlamState, eye: Eye
    ) -> list[tuple[int, int]]:
        """Return the inliers among the pairs ``known`` (index in ``pixels``, index of a map point). ``state``: the
        predicted state. ``eye``: the camera."""
        if len(known) < FEWEST:
            return known
        points = self._map.positions[[p for _, p in known]]
        noise = eye.known(state.robot, points, self._covariances([p for _, p in known])).noise
        try:
            right = consensus.agreeing(eye.model, eye.predicted(state), points, pixels[[i for i, _ in known]], noise)
        except np.linalg.LinAlgError:  # the prediction is not finite or its covariance is singular
            right = np.zeros(len(known), dtype=bool)
        return self._kept(known, right)

    def _kept(self, pairs: list[tuple[int, int]], right: Truths) -> list[tuple[int, int]]:
        if not right.all():
            self._diagnostics.reject(DISAGREES, int(np.count_nonzero(~right)))
        return list(compress(pairs, right.tolist()))

    def _covariances(self, points: Sequence[int]) -> Array | None:
        return self._map.covariances[list(points)].reshape(-1, 3, 3) if self._has_uncertain_points else None

    def _match(
        self,
        pixels: Array,
        ours: list[tuple[int, int]],
        known: list[tuple[int, int]],
        expected: Sequence[int],
        wanted: int,
    ) -> Match:
        both, points = (*ours, *known), [p for _, p in known]
        return Match(
            pixels[[i for i, _ in both]].reshape(-1, 2),
            tuple(p for _, p in ours),
            self._map.positions[points].reshape(-1, 3),
            self._covariances(points),
            frozenset(i for i, _ in both),
            tuple(expected),
            wanted,
        )


def _visible(eye: Eye, sights: Sights) -> tuple[Sights, Integers]:
    """Return the predicted pixels ``sights`` of only those points that are in front of the camera and inside its image.
    Also return the indices of these points."""
    inside = np.flatnonzero((sights.depths > 0.0) & eye.model.contains(sights.pixels))
    return sights[inside], inside


def _slip(match: Match, state: SlamState, eye: Eye, added: Array) -> float:
    """Return the log-likelihood ratio of the matched pixels for slip of the wheels, relative to no slip. ``added`` (3,
    3): the covariance of x, y and heading that slip adds."""
    sights = eye.all(state, match.mapped, match.points, match.covariances)
    covariance = Innovation.of(sights, state.covariance).total(sights.noise)
    # a common error of all depths: points of unknown depth have the same initial depth, so their errors resemble slip
    depths = np.minimum(sights.starts + inverse_depth.SIZE - 1, len(state.covariance) - 1)
    alike = (sights.by_point[:, :, -1] * np.sqrt(state.covariance[depths, depths])[:, None]).ravel()
    by_pose = sights.by_pose[:, :, PLANAR].reshape(-1, 3)
    covariance += np.outer(alike, alike)
    return more_probable((match.pixels - sights.pixels).ravel(), (covariance, covariance + by_pose @ added @ by_pose.T))

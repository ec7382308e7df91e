"""Association of the poses of an estimate with those of the reference, and alignment of both.

Least squares in space: Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
IEEE Transactions on Pattern Analysis and Machine Intelligence, 1991, equations 38 to 43. In the plane:
:func:`~factors.se2.align_points`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.pairing import Pairs, pairs, pairs_in_space, pauses
from factorgraph_loc.files import checks
from factorgraph_loc.model.pose_path import PosePath, upright
from factorgraph_loc.model.scoring import Alignment, Association
from factorgraph_loc.model.trajectory import Trajectory
from factors import se2
from factors.se2 import Array, Integers

FEWEST = 3  # minimum number of pairs of poses for an alignment by least squares
_DEGENERATE = 1e-12  # positions are on a line if the second squared singular value is smaller, relative to the first


@dataclass(frozen=True)
class Associated:
    """N poses of an ``estimate``, and the N poses of the ``reference`` with which they are compared.

    ``gaps``: indices of poses that follow a gap. Relative errors are not computed across gaps. ``from_reference``: if
    true, the lengths of pieces for relative errors are measured along the reference, otherwise along the estimate.
    """

    estimate: PosePath
    reference: PosePath
    gaps: Integers
    from_reference: bool


def associate(
    estimate: PosePath, reference: PosePath, how: Association, *, max_diff: float, max_gap: float
) -> Associated:
    """Return N poses of an estimate, paired with N poses of the reference.

    If a trajectory has no timestamps, poses are paired by index, and both must have the same number of poses. Otherwise
    ``how`` is one of these:

    - "nearest": each pose of the trajectory with fewer poses is paired with the pose of the other that is nearest in
      time. Poses more than ``max_diff`` [s] apart are not paired.
    - "interpolate": the estimate is interpolated at timestamps of the reference, across gaps of at most
      ``max_gap`` [s]. If one trajectory is planar, both are compared in the plane.

    Raises InputError if there are no pairs.
    """
    if estimate.t_ns is None or reference.t_ns is None:
        if how != "nearest":
            without = estimate if estimate.t_ns is None else reference
            raise InputError(
                f"{without.name}: has no timestamps, which --associate interpolate requires: use --associate nearest"
            )
        if len(estimate) != len(reference):
            raise InputError(
                f"{estimate.name}: has {len(estimate)} poses, expected {len(reference)} as {reference.name} has: without stamps, "
                "poses are paired by their row number"
            )
        return Associated(estimate, reference, np.empty(0, dtype=np.int64), from_reference=False)
    if how == "nearest":
        rows, of_reference = _nearest(estimate.seconds(), reference.seconds(), max_diff)
        paired = Associated(
            estimate.rows(rows), reference.rows(of_reference), np.empty(0, dtype=np.int64), from_reference=False
        )
    else:
        paired = _interpolated(estimate, reference, max_gap)
    if not len(paired.estimate):
        raise _nothing_in_common(estimate, reference, how, max_diff, max_gap)
    return paired


def _nearest(estimate: Array, reference: Array, max_diff: float) -> tuple[Integers, Integers]:
    """Return the indices of paired poses of the estimate and of the reference, at most ``max_diff`` [s] apart.
    ``estimate``, ``reference``: their timestamps [s]."""
    swapped = len(estimate) > len(reference)
    short, long = (reference, estimate) if swapped else (estimate, reference)
    later = np.searchsorted(long, short).clip(max=len(long) - 1)
    earlier = np.maximum(later - 1, 0)
    nearest = np.where(np.abs(short - long[earlier]) <= np.abs(long[later] - short), earlier, later)
    kept = np.flatnonzero(np.abs(long[nearest] - short) <= max_diff)
    return (nearest[kept], kept) if swapped else (kept, nearest[kept])


def _interpolated(estimate: PosePath, reference: PosePath, max_gap: float) -> Associated:
    """Return poses of the estimate, interpolated at timestamps of the reference, paired with poses of the reference. If
    one trajectory is planar, both are compared in the plane."""
    t0_ns = int(estimate.stamps()[0])
    if estimate.is_planar or reference.is_planar:
        above, true = (Trajectory.of(path.seen_from_above(), t0_ns) for path in (estimate, reference))
        return in_plane(pairs(above, true, max_gap), above, true, (estimate.name, reference.name), t0_ns)
    paths = pairs_in_space(estimate, reference, max_gap)
    return Associated(*paths, pauses(checks.seconds(paths[1].stamps(), t0_ns)), from_reference=True)


def in_plane(
    pair: Pairs, estimate: Trajectory, reference: Trajectory, names: tuple[str, str] = ("", ""), t0_ns: int = 0
) -> Associated:
    """Return the M paired poses ``pair`` of two planar trajectories as three-dimensional poses. Pairs with NaN become
    gaps.

    ``estimate``, ``reference``: the trajectories. Only their field ``has_heading`` is used. ``names``: their names.
    ``t0_ns``: absolute time [ns] of t = 0.
    """
    known = np.isfinite(pair.poses[:, 0]) & np.isfinite(pair.truth[:, 0])
    kept = np.flatnonzero(known)
    gaps = np.searchsorted(kept, np.concatenate((pauses(pair.t), np.flatnonzero(~known))))
    estimated = Trajectory(pair.t[kept], pair.poses[kept], has_heading=estimate.has_heading)
    truth = Trajectory(pair.t[kept], pair.truth[kept], has_heading=reference.has_heading)
    paths = estimated.path(names[0], t0_ns), truth.path(names[1], t0_ns)
    return Associated(*paths, np.asarray(gaps, dtype=np.int64), from_reference=True)


def _nothing_in_common(
    estimate: PosePath, reference: PosePath, how: Association, max_diff: float, max_gap: float
) -> InputError:
    """Return the error for two trajectories without any pair, with the likely reason."""
    ours, theirs = estimate.seconds(), reference.seconds()
    if ours[0] > theirs[-1] or theirs[0] > ours[-1]:
        spans = (f"{t[0]:.3f} to {t[-1]:.3f} s" for t in (ours, theirs))
        named = " and ".join(f"{path.name} {span}" for path, span in zip((estimate, reference), spans, strict=True))
        return InputError(f"the trajectories do not overlap in time: {named}, expected timestamps of one clock")
    if how == "nearest":
        expected = "a larger --max-diff, or --associate interpolate"
        return InputError(
            f"{estimate.name}: no stamp is within {max_diff:g} s of {reference.name}, expected {expected}"
        )
    return InputError(
        f"{estimate.name}: no stamp of {reference.name} lies between two poses at most {max_gap:g} s apart: use a larger --max-gap"
    )


@dataclass(frozen=True)
class Similarity:
    """The transformation ``scale * rotation @ p + translation`` of a point p (3,) [m]. ``rotation`` (3, 3): a rotation
    matrix. ``translation`` (3,) [m]. ``scale``: 1 for a rigid transformation."""

    rotation: Array
    translation: Array
    scale: float = 1.0

    def of(self, path: PosePath) -> PosePath:
        """Return a path with the transformed poses of ``path``. The scale does not affect rotations."""
        positions = self.scale * path.positions @ self.rotation.T + self.translation
        return replace(path, positions=positions, rotations=self.rotation @ path.rotations)


IDENTITY = Similarity(np.eye(3), np.zeros(3))


def alignment(estimate: PosePath, reference: PosePath, how: Alignment) -> Similarity:
    """Return the transformation that moves the N poses of the ``estimate`` onto the N poses of the ``reference``.

    ``how`` is one of these. All but the first two minimize the sum of squared distances between the positions.

    - "none": the identity.
    - "origin": moves the first pose of the estimate to the first pose of the reference.
    - "se2": a rotation and translation in the plane.
    - "yaw": a rotation about the vertical and a translation in space.
    - "se3": a rotation and translation in space.
    - "sim3": a rotation, translation and scale in space.

    Raises InputError if the poses do not determine the transformation.
    """
    if how == "none":
        return IDENTITY
    if how == "origin":
        if without := next((path for path in (estimate, reference) if not path.has_rotations), None):
            raise InputError(
                f"{without.name}: has no headings, which --align origin needs: expected none, se2, yaw, se3 or sim3"
            )
        rotation = reference.rotations[0] @ estimate.rotations[0].T
        return Similarity(rotation, reference.positions[0] - rotation @ estimate.positions[0])
    if len(estimate) < FEWEST:
        raise InputError(
            f"{estimate.name}: {len(estimate)} poses are paired with {reference.name}, expected at least {FEWEST} for --align {how}"
        )
    if how in ("se2", "yaw"):
        return _planar(estimate, reference, how)
    return _umeyama(estimate, reference, with_scale=how == "sim3")


def _planar(estimate: PosePath, reference: PosePath, how: Alignment) -> Similarity:
    """Return the least-squares motion of ``estimate`` in the plane, with the alignment "se2" or "yaw". With "yaw",
    heights are also shifted by the mean difference from ``reference``."""
    points, targets = estimate.positions[:, :2], reference.positions[:, :2]
    for path, places in ((estimate, points), (reference, targets)):
        if np.abs(places - places[0]).max() <= _DEGENERATE * max(1.0, float(np.abs(places).max())):
            raise InputError(
                f"{path.name}: all positions are equal, so --align {how} cannot find a rotation, expected a path of some length"
            )
    x, y, angle = se2.align_points(points, targets)
    rise = float(np.mean(reference.positions[:, 2] - estimate.positions[:, 2])) if how == "yaw" else 0.0
    return Similarity(upright(np.array([angle]))[0], np.array((x, y, rise)))


def _umeyama(estimate: PosePath, reference: PosePath, *, with_scale: bool) -> Similarity:
    """Return the least-squares transformation in space by Umeyama's method. ``with_scale``: estimate a scale too."""
    centre, target = estimate.positions.mean(axis=0), reference.positions.mean(axis=0)
    a, b = estimate.positions - centre, reference.positions - target
    left, singular, right = np.linalg.svd(b.T @ a / len(a))
    for path, places in ((estimate, a), (reference, b)):
        of_path = np.linalg.svd(places, compute_uv=False)
        if not of_path[1] ** 2 > _DEGENERATE * of_path[0] ** 2:
            raise InputError(
                f"{path.name}: its positions lie on a line, so --align {'sim3' if with_scale else 'se3'} has no unique rotation, "
                "expected a path with a bend: use se2 or origin"
            )
    signs = np.array((1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))))
    rotation = (left * signs) @ right
    scale = float(singular @ signs / np.mean(np.sum(a**2, axis=1))) if with_scale else 1.0
    return Similarity(rotation, target - scale * rotation @ centre, scale)

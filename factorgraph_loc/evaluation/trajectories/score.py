"""Absolute and relative errors of an estimated trajectory against a reference.

Absolute (APE) and relative pose errors (RPE): Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems",
IROS 2012, section IV. Relative errors are also computed over a metre of path. With the association ``nearest`` the
figures are those of the package evo.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation import pairing
from factorgraph_loc.evaluation.pairing import DELTA, TOLERANCE, pauses, summarize
from factorgraph_loc.evaluation.trajectories.association import Associated, Similarity, alignment, associate
from factorgraph_loc.model.planar import MOST, RISE
from factorgraph_loc.model.pose_path import PosePath, require_poses
from factorgraph_loc.model.scoring import (
    ALIGNMENTS,
    ASSOCIATIONS,
    MAX_DIFF,
    MAX_GAP,
    Alignment,
    Association,
    check_max_gap,
)
from factorgraph_loc.text import Notice, listed, notice, quoted
from factors.se2 import Array, Integers

_MANY = 0.5  # there is a warning if a smaller fraction of the poses is paired


@dataclass(frozen=True)
class PoseErrors:
    """K absolute or relative pose errors.

    ``position`` (K,) [m]. ``rotation`` (K,) [rad]: an angle, None if a trajectory has no rotations. ``ends`` (K,):
    index of the pose of an absolute error. A relative error is over a section of the path, and ``ends`` is the index of
    its last pose.
    """

    position: Array
    rotation: Array | None
    ends: Integers

    def figures(self, name: str) -> dict[str, float | None]:
        """Return the statistics of the errors by key, such as ``NAME.position_rmse`` for the ``name`` NAME. The
        statistics are rmse, mean, median, p95, max, min and std. They are None if there are no errors."""
        figures: dict[str, float | None] = {}
        for what, values in (("position", self.position), ("rotation", self.rotation)):
            statistics = summarize(np.empty(0) if values is None else values)
            figures |= {f"{name}.{what}_{how}": value for how, value in statistics.items()}
        return figures


@dataclass(frozen=True)
class TrajectoryScore:
    """The result of the comparison of an estimated trajectory with a reference.

    ``estimate``, ``reference``: the N paired poses of both, after the alignment. ``transform``: the alignment, from the
    frame of the estimate to the frame of the reference. ``ape``: N absolute errors. ``rpe_per_m``, ``rpe_per_s``:
    relative errors over a metre of path and over a second, None without rotations or timestamps. ``rpe``: relative
    errors over other distances and durations, by a text such as "5m". ``lengths`` [m], ``poses``: length and number of
    poses of the whole estimate and of the whole reference. ``settings``: the settings of association and alignment.
    ``warnings``: likely mistakes in the comparison.
    """

    estimate: PosePath
    reference: PosePath
    transform: Similarity
    ape: PoseErrors
    rpe_per_m: PoseErrors | None
    rpe_per_s: PoseErrors | None
    rpe: Mapping[str, PoseErrors]
    lengths: tuple[float, float]
    poses: tuple[int, int]
    settings: dict[str, Any]
    warnings: tuple[Notice, ...]

    @property
    def figures(self) -> dict[str, float | None]:
        """All statistics by key, in metres and radians. A statistic that is undefined is None.

        ``pairs``: number of compared poses. ``ape.position_*``, ``ape.rotation_*``: absolute pose errors.
        ``rpe_per_m.position_*`` and so on: relative errors. The endings * are ``rmse``, ``mean``, ``median``, ``p95``,
        ``max``, ``min`` and ``std``. ``rpe_per_m.pieces``, ``rpe_per_s.pieces``: number of relative errors.
        """
        figures: dict[str, float | None] = {"pairs": len(self.estimate)}
        figures |= self.ape.figures("ape")
        by_delta = [(f"rpe_{delta}", errors) for delta, errors in self.rpe.items()]
        for name, errors in (("rpe_per_m", self.rpe_per_m), ("rpe_per_s", self.rpe_per_s), *by_delta):
            known = errors or _NONE
            figures |= known.figures(name) | {f"{name}.pieces": len(known.position) if errors else None}
        return figures

    def seconds(self) -> Array | None:
        """Return the times (N,) [s] of the N paired poses since the first pair, or None if there are no timestamps."""
        return _seconds(self.estimate, self.reference)

    def document(self) -> dict[str, Any]:
        """Return the result as a dictionary for JSON: settings, statistics, the alignment and the warnings."""
        names = ("estimate", "reference")
        extents = zip(names, self.poses, self.lengths, strict=True)
        return {
            **{name: path.name for name, path in zip(names, (self.estimate, self.reference), strict=True)},
            **self.settings,
            **{
                f"{name}.{what}": value
                for name, *of in extents
                for what, value in zip(("poses", "length"), of, strict=True)
            },
            **self.figures,
            "transform.rotation": self.transform.rotation.tolist(),
            "transform.translation": self.transform.translation.tolist(),
            "transform.scale": self.transform.scale,
            "warnings": [str(warning) for warning in self.warnings],
        }


_NONE = PoseErrors(np.empty(0), np.empty(0), np.empty(0, dtype=np.int64))


def score_paths(
    estimate: PosePath,
    reference: PosePath,
    align: Alignment = "none",
    associate_by: Association = "nearest",
    *,
    max_diff: float = MAX_DIFF,
    max_gap: float = MAX_GAP,
    all_pairs: bool = False,
    align_poses: int | None = None,
    delta: Sequence[str] = (),
) -> TrajectoryScore:
    """Return the errors of an estimated trajectory against a reference.

    ``align``: transformation of the estimate before the comparison, from "none" to "sim3", see
    :func:`~factorgraph_loc.evaluation.trajectories.association.alignment`. With "se2" heights are ignored.
    ``associate_by``: "nearest" pairs the poses nearest in time, at most ``max_diff`` [s] apart. "interpolate"
    interpolates estimates, across at most ``max_gap`` [s]. ``all_pairs``: if true, relative errors are over a section
    of the path from each pose, otherwise over successive sections. ``align_poses``: number of the first poses that
    determine the alignment, None for all. ``delta``: more lengths of relative errors, such as "5m" or "2s".

    Raises InputError if no poses can be paired, the poses do not determine the alignment, or an argument is invalid.
    """
    _check(align, associate_by, max_diff, max_gap)
    if align_poses is not None and (align_poses < 1 or align in ("none", "origin")):
        raise InputError(f"align_poses is {align_poses}, expected 1 or more, together with align se2, yaw, se3 or sim3")
    deltas = {text: _delta(text) for text in delta}
    require_poses(estimate)
    require_poses(reference)
    pair = associate(estimate, reference, associate_by, max_diff=max_diff, max_gap=max_gap)
    aligned, truth = pair.estimate, pair.reference
    if align == "se2":
        aligned, truth = aligned.seen_from_above(), truth.seen_from_above()
    first = np.arange(len(aligned))[:align_poses]
    transform = alignment(aligned.rows(first), truth.rows(first), align)
    aligned = transform.of(aligned)
    settings: dict[str, Any] = {"align": align, "associate": associate_by, "all_pairs": all_pairs}
    settings |= {} if align_poses is None else {"align_poses": align_poses}
    if aligned.t_ns is not None and truth.t_ns is not None:
        settings |= {"max_diff": max_diff} if associate_by == "nearest" else {"max_gap": max_gap}
    moved = replace(pair, estimate=aligned, reference=truth)
    errors = pose_errors(moved, all_pairs=all_pairs)
    by_delta = {
        text: relative
        for text, (length, unit) in deltas.items()
        if (relative := relative_errors(moved, length, unit, all_pairs=all_pairs)) is not None
    }
    lengths = float(_steps(estimate).sum()), float(_steps(reference).sum())
    poses = len(estimate), len(reference)
    warnings = [*estimate.warnings, *reference.warnings, *_height_warnings(estimate, reference, associate_by, align)]
    if associate_by == "nearest" and len(aligned) < _MANY * min(poses):
        sentence = (
            "{estimate}: only {paired} of {poses} poses are within {max_diff:g} s of a pose of {reference}: "
            "set a larger max_diff, or associate interpolate"
        )
        values = estimate.name, len(aligned), min(poses), max_diff, reference.name
        warnings.append(notice("few_pairs", sentence, *values))
    return TrajectoryScore(aligned, truth, transform, *errors, by_delta, lengths, poses, settings, tuple(warnings))


def pose_errors(
    pair: Associated, *, all_pairs: bool = False
) -> tuple[PoseErrors, PoseErrors | None, PoseErrors | None]:
    """Return three sets of errors: absolute, relative over a metre of path, and relative over a second.

    Relative errors are None without rotations. Those over a second are also None without timestamps. ``all_pairs``: if
    true, relative errors are over overlapping sections of the path, one from each pose. Otherwise the sections are
    successive.
    """
    estimate, truth = pair.estimate, pair.reference
    distance = np.linalg.norm(estimate.positions - truth.positions, axis=1)
    ape = PoseErrors(distance, None, np.arange(len(estimate)))
    if estimate.has_rotations and truth.has_rotations:
        ape = replace(ape, rotation=_angles(estimate.rotations.transpose(0, 2, 1) @ truth.rotations))
    per_m, per_s = (relative_errors(pair, DELTA, unit, all_pairs=all_pairs) for unit in "ms")
    return ape, per_m, per_s


def relative_errors(pair: Associated, length: float, unit: str, *, all_pairs: bool = False) -> PoseErrors | None:
    """Return the errors of the estimated motion over each of many sections of a path.

    ``length``, ``unit``: of a section, in metres of path ("m") or in seconds ("s"). ``all_pairs``: if true, a section
    begins at each pose. Otherwise the sections are successive. Returns None if there are no rotations, or no timestamps
    for the unit "s".
    """
    estimate, truth = pair.estimate, pair.reference
    if not (estimate.has_rotations and truth.has_rotations):
        return None
    if unit == "m":
        path = _steps(truth if pair.from_reference else estimate)
        return _relative(estimate, truth, path, length, pair.gaps, all_pairs=all_pairs)
    if (t := _seconds(estimate, truth)) is None:
        return None
    gaps = np.union1d(pair.gaps, pauses(t))
    return _relative(estimate, truth, np.diff(t), length - TOLERANCE, gaps, all_pairs=all_pairs)


def _delta(text: str) -> tuple[float, str]:
    """Return the number and the unit of a distance or duration such as "5m". Raises InputError for other text."""
    try:
        length = float(text[:-1])
    except ValueError:
        length = np.nan
    if text[-1:] not in ("m", "s") or not 0.0 < length < np.inf:
        raise InputError(f"delta is {quoted(text)}, expected a distance or a duration, such as 5m or 2s")
    return length, text[-1]


def _check(align: str, associate_by: str, max_diff: float, max_gap: float) -> None:
    """Raise InputError if an argument of :func:`score_paths` is invalid."""
    for name, value, known in (("align", align, ALIGNMENTS), ("associate", associate_by, ASSOCIATIONS)):
        if value not in known:
            raise InputError(f"{name} is {quoted(value)}, expected one of {listed(known)}")
    if not 0.0 <= max_diff < np.inf:
        raise InputError(f"max_diff is {max_diff:g}, expected a time of 0 s or more")
    check_max_gap(max_gap)


def _relative(
    estimate: PosePath, truth: PosePath, steps: Array, length: float, gaps: Integers, *, all_pairs: bool
) -> PoseErrors:
    """Return the position and rotation errors of the estimated motion over each section of a path.

    They are the translation and the rotation angle of ``Q^-1 P``. Q is the motion of the reference over the section,
    and P the motion of the estimate. ``steps`` (N - 1,): distances or times between poses. ``length``: of a section, in
    the same unit. ``gaps``: indices of poses that follow a gap. No section contains a gap.
    """
    cut = pairing.all_pairs if all_pairs else pairing.successive
    inner = np.unique(gaps[(gaps > 0) & (gaps < len(estimate))]).tolist()
    pieces = [piece for a, b in pairwise([0, *inner, len(estimate)]) for piece in cut(steps[a : b - 1], length, a)]
    begins, ends = np.array(pieces, dtype=np.int64).reshape(-1, 2).T
    (turn, shift), (true_turn, true_shift) = (_motions(path, begins, ends) for path in (estimate, truth))
    back = true_turn.transpose(0, 2, 1)
    error = np.linalg.norm(np.einsum("kij,kj->ki", back, shift - true_shift), axis=1)
    return PoseErrors(error, _angles(back @ turn), ends)


def _motions(path: PosePath, begins: Integers, ends: Integers) -> tuple[Array, Array]:
    """Return rotations (K, 3, 3) and translations (K, 3) from the poses with indices ``begins`` to ``ends``. They are
    in the frames of the poses ``begins``."""
    back = path.rotations[begins].transpose(0, 2, 1)
    shifts = path.positions[ends] - path.positions[begins]
    return back @ path.rotations[ends], np.einsum("kij,kj->ki", back, shifts)


def _steps(path: PosePath) -> Array:
    """Return the distances (N - 1,) [m] between successive poses."""
    return np.asarray(np.linalg.norm(np.diff(path.positions, axis=0), axis=1))


def _angles(rotations: Array) -> Array:
    """Return the angles (K,) [rad] of rotations (K, 3, 3). Use of sine and cosine makes all angles accurate."""
    sine = np.linalg.norm(rotations - rotations.transpose(0, 2, 1), axis=(1, 2)) / np.sqrt(8.0)
    cosine = (np.trace(rotations, axis1=1, axis2=2) - 1.0) / 2.0
    return np.asarray(np.arctan2(sine, cosine))


def _seconds(estimate: PosePath, truth: PosePath) -> Array | None:
    """Return the times (N,) [s] of N paired poses since the first pair, or None if neither path has timestamps. They
    are by the timestamps of the ``estimate``, or else of the reference (``truth``)."""
    t_ns = truth.t_ns if estimate.t_ns is None else estimate.t_ns
    return None if t_ns is None else (t_ns - t_ns[:1]) / 1e9


def _height_warnings(
    estimate: PosePath, reference: PosePath, associate_by: Association, align: Alignment
) -> list[Notice]:
    """Return warnings about heights that vary although ``align`` ignores them. Also return a warning if a planar
    trajectory is compared with a trajectory at other heights."""
    if align == "se2":
        rises = [(path.name, float(np.ptp(path.positions[:, 2]))) for path in (estimate, reference)]
        sentence = "{path}: z varies by {rise:.1f} m and is ignored: check that its z axis points up"
        return [notice("not_planar", sentence, name, rise) for name, rise in rises if rise > MOST]
    flat, uneven = (estimate, reference) if estimate.is_planar else (reference, estimate)
    if associate_by == "interpolate" or not flat.is_planar or align in ("se3", "sim3"):
        return []
    apart = float(np.abs(uneven.positions[:, 2] - flat.positions[0, 2]).max())
    if apart <= RISE:
        return []
    sentence = (
        "{planar} is planar, and {other} is up to {height:.1f} m above or below it. Errors include the difference in height: set "
        "align se2 or associate interpolate to exclude it"
    )
    return [notice("heights_count", sentence, flat.name, uneven.name, apart)]

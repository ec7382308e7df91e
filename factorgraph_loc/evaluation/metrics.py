"""Accuracy of a trajectory against the reference, and consistency of its covariances.

Trajectories are compared without alignment, except on request or if the run estimated its map in a frame of its own.

Pairing of poses: :mod:`factorgraph_loc.evaluation.pairing`. NEES and its bounds: Bar-Shalom, Li, Kirubarajan,
"Estimation with Applications to Tracking and Navigation", 2001, section 5.4. Relative pose errors:
:mod:`factorgraph_loc.evaluation.trajectories.score`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.pairing import CONFIDENCE, TOLERANCE, Pairs, pairs, rms, summarize
from factorgraph_loc.evaluation.scores import ACCURACY, ALIGNED, OF_FREE_MAP
from factorgraph_loc.evaluation.trajectories.association import in_plane
from factorgraph_loc.evaluation.trajectories.score import pose_errors, score_paths
from factorgraph_loc.evaluation.warned import WARNINGS
from factorgraph_loc.model.belief import Learnt, LearntPoint
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult, Timings
from factorgraph_loc.model.scoring import MAX_GAP, Alignment
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.text import notice
from factors import chi_squared, positive, se2
from factors.se2 import Array

FEWEST_SCORED = 10  # minimum number of compared poses; with fewer a trajectory has no scores
FREE_MAP = "unknown"  # value of the setting ``landmarks`` of an estimator that estimates the map


@dataclass(frozen=True)
class Errors:
    """Errors of a trajectory at N times of the reference. All errors are NaN in gaps of the trajectory.

    ``t`` (N,): times [s]. ``poses``, ``reference`` (N, 3): the compared poses (x, y, heading).
    ``difference`` (N, 3): estimate minus reference in x, y [m, world frame] and heading [rad, wrapped].
    ``position`` (N,): distance [m]. ``heading`` (N,): absolute difference [rad], NaN if the reference has no heading.
    ``nees`` (N,): normalised estimation error squared of x, y and heading, or of x and y if the reference has no
    heading.
    ``dof``: number of these components, 3 or 2. ``nees_position`` (N,): normalised estimation error squared of x and y.
    ``invalid`` (N,): mask of the poses with a covariance that is not positive definite. The NEES are NaN there.
    """

    t: Array
    poses: Array
    reference: Array
    difference: Array
    position: Array
    heading: Array
    nees: Array
    nees_position: Array
    dof: int
    invalid: NDArray[np.bool_]


def errors(trajectory: Trajectory, reference: Trajectory, max_gap: float = MAX_GAP) -> Errors:
    """Return the errors of a trajectory against the reference, without alignment.

    The errors are at timestamps of the reference that are at least 0.1 s apart, with estimates interpolated at them.
    ``max_gap`` [s]: errors are NaN between estimates that are further apart.
    """
    if trajectory.covariances is not None:
        unsound = ~_positive_definite(trajectory.covariances)
        trajectory = replace(trajectory, covariances=np.where(unsound[:, None, None], np.nan, trajectory.covariances))
    pair = pairs(trajectory, reference, max_gap)
    difference = pair.poses - pair.truth
    difference[:, 2] = se2.wrap(difference[:, 2])
    known = np.isfinite(difference[:, 0])
    if not reference.has_heading:
        difference[:, 2] = np.nan
    dof = 3 if reference.has_heading else 2
    nees, nees_position = np.full(len(known), np.nan), np.full(len(known), np.nan)
    invalid = np.zeros(len(known), dtype=bool)
    if pair.covariances is not None:
        good = known & np.isfinite(pair.covariances[:, 0, 0])
        invalid = known & ~good
        nees[good] = _squared(difference[good, :dof], pair.covariances[good, :dof, :dof])
        nees_position[good] = _squared(difference[good, :2], pair.covariances[good, :2, :2])
    return Errors(
        t=pair.t,
        poses=pair.poses,
        reference=pair.truth,
        difference=difference,
        position=np.hypot(difference[:, 0], difference[:, 1]),
        heading=np.abs(difference[:, 2]),
        nees=nees,
        nees_position=nees_position,
        dof=dof,
        invalid=invalid,
    )


def score(result: RunResult, log: Log, align: Alignment = "none") -> dict[str, Any]:
    """Return all scores of a run by key, in metres and radians. A score that is undefined is None.

    - ``scoring.max_gap`` [s]: the maximum gap across which estimates are interpolated. Compare only runs with equal
      values.
    - ``causal.*``, ``final.*``: scores of the online and of the final trajectory, see :func:`accuracy`. They begin when
      the robot is first localized. Without a reference, or with fewer than :data:`FEWEST_SCORED` poses, all but
      ``scored`` are None.
    - ``time_to_localized`` [s]: time from the start of the run until the robot is localized.
    - ``landmarks.*``: see :func:`landmark_figures`; None unless the run estimated the map.
    - ``learnt.NAME.value`` and ``learnt.NAME.sigma``: value and standard deviation of each estimated constant of a
      sensor.
    - ``nis.SENSOR.*``: statistics of innovations. ``ignored.*``, ``rejected.*``, ``late.*``: numbers of unused
      detections. ``timing.*``: computing times. ``warnings``: a list of texts. They exist in every run.

    ``align``: how to align the trajectories with the reference. If the run estimated its map, "none" becomes "se2".
    With an alignment there are also ``scoring.align`` and the errors :data:`ALIGNED` [m, rad]. These are errors after
    alignment by :func:`~factorgraph_loc.evaluation.trajectories.score.score_paths`. If the poses do not determine the
    alignment, these errors are None and there is a warning.
    """
    causal = result.causal()
    final = result.final
    if causal is not None:
        final = final.rows(final.t >= causal.t[0] - TOLERANCE)
    gap = result.max_gap
    scores: dict[str, Any] = {"scoring.max_gap": gap, WARNINGS: list(result.warnings)}
    trajectories = (("causal", causal), ("final", final))
    for kind, trajectory in trajectories:
        figures = dict.fromkeys(ACCURACY) if trajectory is None else accuracy(trajectory, log.reference, gap)
        if (figures["scored"] or 0) < FEWEST_SCORED:
            figures = dict.fromkeys(ACCURACY) | {"scored": figures["scored"]}
        scores |= {f"{kind}.{name}": value for name, value in figures.items()}
    scores["time_to_localized"] = None if causal is None else float(causal.t[0] - result.t[0])
    scores |= dict.fromkeys(OF_FREE_MAP)
    if result.config.get("settings", {}).get("landmarks") == FREE_MAP:
        scores |= landmark_figures(final, result.learnt.landmarks, log, gap)
        align = "se2" if align == "none" else align
    scores |= _constants(result.learnt) | _counts(result.diagnostics) | _timing(result.timings)
    if align != "none":
        scores["scoring.align"] = align
        for kind, trajectory in trajectories:
            aligned: dict[str, float | None] = dict.fromkeys(ALIGNED)
            try:
                aligned |= _aligned(trajectory, log, align, gap)
            except InputError as error:
                warning = notice("not_aligned", "not aligned: {error}", error)
                scores[WARNINGS] = list(dict.fromkeys((*scores[WARNINGS], warning)))
            scores |= {f"{kind}.{name}": value for name, value in aligned.items()}
    return scores


def _aligned(trajectory: Trajectory | None, log: Log, align: Alignment, max_gap: float) -> dict[str, float | None]:
    if trajectory is None or log.reference is None or not len(trajectory):
        return {}
    paths = trajectory.path(log.name), log.reference.path("the reference")
    scored = score_paths(*paths, align, "interpolate", max_gap=max_gap).figures
    return {name: scored[f"ape.{name.removeprefix('aligned_')}"] for name in ALIGNED}


def accuracy(trajectory: Trajectory, reference: Trajectory | None, max_gap: float = MAX_GAP) -> dict[str, Any]:
    """Return the scores of one trajectory against the reference, by name. All are None if there is no reference.
    ``max_gap`` [s]: see :func:`errors`.

    - ``position_*`` [m], ``heading_*`` [rad]: ``rmse``, ``median``, ``p95`` and ``max`` of the errors, see
      :func:`errors`.
    - ``rpe_position_per_m``, ``rpe_heading_per_m``: root mean square of the relative errors over pieces of one metre of
      path, see :func:`~factorgraph_loc.evaluation.trajectories.score.pose_errors`. ``rpe_pieces``: number of these
      pieces.
    - ``rpe_position_per_s``, ``rpe_heading_per_s``: root mean square of the relative errors over pieces of one second.
    - ``anees``: mean NEES, ideally 3, or 2 if the reference has no heading.
    - ``nees_bounds``: 95 % interval of the ANEES of a consistent estimator with independent errors. Errors along a
      trajectory are correlated, so a consistent estimator is outside of the interval in more than 5 % of runs.
    - ``coverage_95``: fraction of the times at which the true (x, y) lies in the 95 % ellipse of the estimate.
    - ``invalid_covariances``: number of scored poses with a covariance that is not positive definite. ``anees``,
      ``nees_bounds`` and ``coverage_95`` exclude them.
    - ``scored``: number of compared poses.
    """
    figures: dict[str, Any] = dict.fromkeys(ACCURACY)
    if reference is None:
        return figures
    e = errors(trajectory, reference, max_gap)
    for name, values in (("position", e.position), ("heading", e.heading)):
        statistics = summarize(values)
        figures |= {key: value for how, value in statistics.items() if (key := f"{name}_{how}") in ACCURACY}
    _, per_m, per_s = pose_errors(in_plane(Pairs(e.t, e.poses, None, e.reference), trajectory, reference))
    for unit, relative in (("m", per_m), ("s", per_s)):
        if relative is not None and relative.rotation is not None:
            figures[f"rpe_position_per_{unit}"] = rms(relative.position)
            figures[f"rpe_heading_per_{unit}"] = rms(relative.rotation)
    figures["rpe_pieces"] = None if per_m is None else len(per_m.position)
    nees = e.nees[np.isfinite(e.nees)]
    if len(nees):
        tail = (1.0 - CONFIDENCE) / 2.0
        figures["anees"] = float(np.mean(nees))
        figures["nees_bounds"] = [
            float(chi_squared.quantile(p, len(nees) * e.dof) / len(nees)) for p in (tail, 1.0 - tail)
        ]
        inside = e.nees_position[np.isfinite(e.nees_position)] <= chi_squared.quantile(CONFIDENCE, 2)
        figures["coverage_95"] = float(np.mean(inside))
    figures["invalid_covariances"] = int(np.sum(e.invalid))
    figures["scored"] = int(np.sum(np.isfinite(e.position)))
    return figures


def landmark_figures(
    trajectory: Trajectory, landmarks: Mapping[str, LearntPoint], log: Log, max_gap: float = MAX_GAP
) -> dict[str, Any]:
    """Return the scores of the landmarks of a run that estimated its map. A score that is undefined is None.

    ``landmarks``: the estimated landmarks. They are compared with the map of the log, after the planar alignment of
    ``trajectory`` with the reference. Without a reference, the landmarks themselves are aligned with the map.
    ``max_gap`` [s]: see :func:`errors`.

    - ``landmarks.count``: number of estimated landmarks that are also in the map of the log.
    - ``landmarks.rmse`` [m]: root mean square distance of these landmarks from their positions in the map.
    - ``landmarks.anees``: mean NEES of these landmarks, ideally 2. It is usually below 2, because the covariances
      include the uncertainty of the start, which the alignment removes.
    """
    figures: dict[str, Any] = dict.fromkeys(OF_FREE_MAP)
    names = [name for name in landmarks if name in log.world.landmarks]
    figures["landmarks.count"] = len(names)
    positions = np.array([landmarks[name].position for name in names]).reshape(-1, 2)
    truth = np.array([log.world.position(name) for name in names]).reshape(-1, 2)
    if log.reference is None:
        pose = se2.align_points(positions, truth)
    else:
        pair = pairs(trajectory, log.reference, max_gap)
        pose = se2.align_points(pair.poses[:, :2], pair.truth[:, :2])
    if names and np.isfinite(pose).all():
        # errors in the frame of the estimate, which is the frame of the covariances
        error = positions - se2.transform_to(pose, truth)
        figures["landmarks.rmse"] = rms(np.hypot(error[:, 0], error[:, 1]))
        covariances = np.array([landmarks[name].covariance for name in names])
        if (good := _positive_definite(covariances)).any():
            figures["landmarks.anees"] = float(np.mean(_squared(error[good], covariances[good])))
    return figures


def _positive_definite(covariances: Array) -> NDArray[np.bool_]:
    """Return a mask (N,) of the matrices (N, D, D) that are finite and positive definite."""
    finite: NDArray[np.bool_] = np.all(np.isfinite(covariances), axis=(1, 2))
    smallest = np.linalg.eigvalsh(np.where(finite[:, None, None], covariances, np.eye(covariances.shape[-1])))[:, 0]
    return np.asarray(finite & (smallest > 0.0))


def _squared(difference: Array, covariances: Array) -> Array:
    """Return the squared Mahalanobis distances (N,) of ``difference`` (N, D) with ``covariances`` (N, D, D)."""
    whitened = positive.solve(covariances, difference[..., None])[..., 0]
    return np.asarray(np.sum(difference * whitened, axis=1))


def _constants(learnt: Learnt) -> dict[str, float]:
    figures: dict[str, float] = {}
    for name, (value, sigma) in learnt.values.items():
        figures |= {f"learnt.{name}.value": value, f"learnt.{name}.sigma": sigma}
    return figures


def _counts(diagnostics: Diagnostics) -> dict[str, Any]:
    """Return the diagnostics of a run as scores by key.

    - ``nis.SENSOR.median_ratio``: median of the NIS divided by its expected median, ideally 1.
      ``nis.SENSOR.beyond_95``: fraction above the 95 % bound. ``nis.SENSOR.count``: number of innovations.
    - ``residual.NAME.rms`` and ``residual.NAME.median_abs`` [m or rad]: of measurement minus prediction.
    - ``ignored.*``, ``rejected.*``, ``late.*``: numbers of unused measurements, in total and by reason.
    - ``KIND.NAME``: probability that the map is wrong about the landmark or tag NAME. KIND is the kind of error, such
      as ``moved_tags``. ``KIND.total``: number of these landmarks or tags.
    - ``events``: number of events.
    """
    figures: dict[str, Any] = {}
    for sensor, rows in sorted(diagnostics.nis.items()):
        if rows:
            _, nis, dof = np.array(rows, dtype=float).T
            valid = (dof > 0.0) & np.isfinite(nis)
            nis, dof = nis[valid], dof[valid]
            # the median, because a few outliers dominate the mean
            figures[f"nis.{sensor}.median_ratio"] = (
                float(np.median(nis / chi_squared.quantile(0.5, dof))) if len(nis) else None
            )
            figures[f"nis.{sensor}.beyond_95"] = (
                float(np.mean(nis > chi_squared.quantile(CONFIDENCE, dof))) if len(nis) else None
            )
        figures[f"nis.{sensor}.count"] = len(rows)
    for name, errors in sorted(diagnostics.residuals.items()):
        if errors:
            known = np.array(errors)[np.isfinite(errors)]
            figures[f"residual.{name}.rms"] = rms(known)
            figures[f"residual.{name}.median_abs"] = float(np.median(np.abs(known))) if len(known) else None
    for kind in ("ignored", "rejected", "late"):
        counts: dict[str, int] = getattr(diagnostics, kind)
        figures[f"{kind}.total"] = sum(counts.values())
        figures |= {f"{kind}.{reason}": count for reason, count in sorted(counts.items())}
    for kind, doubted in diagnostics.doubted.items():
        figures[f"{kind}.total"] = len(doubted)
        figures |= {f"{kind}.{name}": probability for name, probability in sorted(doubted.items())}
    figures["events"] = len(diagnostics.events)
    return figures


def _timing(timings: Timings) -> dict[str, Any]:
    ms = timings.update_ms
    return {
        "timing.updates": len(ms),
        "timing.update_ms_median": float(np.median(ms)) if len(ms) else None,
        "timing.update_ms_p99": float(np.percentile(ms, 99)) if len(ms) else None,
        "timing.update_ms_max": float(np.max(ms)) if len(ms) else None,
        "timing.causal_seconds": timings.causal_seconds,
        "timing.real_time_factor": timings.real_time_factor,
        "timing.final_seconds": timings.final_seconds,
        "timing.peak_memory_mb": timings.peak_memory_mb,
        "timing.images": timings.images,
        "timing.frontend_seconds": timings.frontend_seconds,
    }

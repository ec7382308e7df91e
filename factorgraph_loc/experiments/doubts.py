"""Warnings about a run: too short a reference, an inaccurate map, gaps without measurements, a robot that is never localized."""

from collections.abc import Sequence

import numpy as np

from factorgraph_loc.evaluation.metrics import FEWEST_SCORED
from factorgraph_loc.evaluation.pairing import pairs
from factorgraph_loc.model.belief import Status
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.setup import MapFrame
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.registry import detecting
from factorgraph_loc.text import Notice, notice

LEAST_SHARE = 0.9  # minimum fraction of the estimates' time span that the reference covers; below it there is a warning


def partly_scored(log: Log, final: Trajectory, max_gap: float) -> tuple[Notice, ...]:
    """Return a tuple with a warning if scores are impossible or cover only part of the run, else an empty tuple.

    Scores are impossible if the reference has too few poses. ``final``: the final trajectory. ``max_gap`` [s]: maximum
    gap across which estimates are interpolated for scores.
    """
    reference = log.reference
    if reference is None or not len(reference) or not len(final):
        return ()
    count = int(np.sum(np.isfinite(pairs(final, reference, max_gap).poses[:, 0])))
    if count < FEWEST_SCORED:
        few = "{log}: only {poses} poses of the reference have an estimate, expected at least {least}: there are no scores"
        return (notice("few_scored", few, log.name, count, FEWEST_SCORED),)
    begin, end = max(reference.t[0], final.t[0]), min(reference.t[-1], final.t[-1])
    whole = final.t[-1] - final.t[0]
    if end - begin >= LEAST_SHARE * whole:
        return ()
    sentence = "{log}: scored over {scored:.1f} s of {whole:.1f} s: the reference covers {begin:.1f} s to {end:.1f} s"
    return (notice("partly_scored", sentence, log.name, end - begin, whole, begin, end),)


def map_error_warning(log: Log, frame: MapFrame, final: Trajectory) -> tuple[Notice, ...]:
    """Return a tuple with a warning about the error of a map that was made without a reference. Empty for other maps.
    The warning states the median and the maximum of the error along the trajectory ``final``. ``frame``: has the
    covariance of this error at each pose."""
    if frame.error is None or not len(final):
        return ()
    worst = np.linalg.eigvalsh(frame.error(final.poses)[:, :2, :2])[:, -1]
    median, most = np.sqrt((np.median(worst), worst.max()))
    sentence = (
        "{log}: the map was made without a reference. Along the trajectory the map's error has a standard deviation of "
        "{median:.2g} m (median), {most:.2g} m at most. The covariances of the estimates include it"
    )
    return (notice("bent_map", sentence, log.name, median, most),)


def with_pauses(log: Log, skipped: Sequence[tuple[float, float]], tick_gap: float) -> tuple[Notice, ...]:
    """Return a tuple with a warning about gaps between measurements, which have no estimates. Empty without gaps.
    ``skipped``: begin and end [s] of each gap. ``tick_gap`` [s]: the minimum length of such a gap."""
    if not skipped:
        return ()
    begin, end = max(skipped, key=lambda gap: gap[1] - gap[0])
    count = "a gap" if len(skipped) == 1 else f"{len(skipped)} gaps"
    sentence = (
        "{log}: {gaps} above {limit:g} s without measurements and estimates, the longest {length:.0f} s at {t:.1f} s"
    )
    return (notice("gaps", sentence, log.name, count, tick_gap, end - begin, begin),)


def never_localized(
    log: Log, sensors: Sequence[str], status: Sequence[Status], final: Trajectory
) -> tuple[Notice, ...]:
    """Return a warning with a likely reason if the start is unknown and the robot was never localized.

    ``sensors``: the used sensors. ``status``: of each causal estimate, such as "localized". ``final``: the trajectory.
    """
    kinds_of_status = set(status)
    if "localized" in kinds_of_status or (len(final) and status[-1] == "unlocalized"):  # the latter: a batch estimator
        return ()
    kinds = detecting(log.world, sensors)
    names = " and ".join(kind.detects or kind.name for kind in kinds)
    if not kinds:
        why = "the map has nothing that its sensors can detect"
    elif "ambiguous" in kinds_of_status:
        why = f"its {names} match several poses"
    elif len(kinds) > 1:
        why = f"its {names} did not determine the pose"
    else:
        why = f"no {names} of the map were detected" if kinds[0].detects else f"the log has no {names}"
    return (notice("never_localized", "{log}: never localized: {why}", log.name, why),)

"""Summarises the measured positions of a log, and compares them with the reference and the odometry."""

import numpy as np

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.interfaces import Paragraph, Summary
from factorgraph_loc.sensors.motion import integrated, odometry_model
from factorgraph_loc.sensors.odometry.measurement import IncrementStream, VelocityStream
from factorgraph_loc.sensors.positions.measurement import PositionSettings, PositionStream, are_plausible
from factorgraph_loc.text import notice
from factors import se2
from factors.se2 import Array

MAX_GAP = 1.0  # s; longest interpolated gap between poses of the reference
SPAN = 10.0  # s; positions and odometry are compared over time spans of this length
SMALL = 0.1  # a smaller ratio of the distance by positions to the distance by odometry causes a warning
DRIVEN = 1.0  # m; time spans with a shorter path of the robot are not compared


def summarize(log: Log) -> Summary:
    """Return the summary of the positions in a log: their number, their median error against the reference, and
    warnings about implausible covariances, repeated positions and a wrong unit."""
    stream, settings = log.streams.get("position"), log.rig.find(PositionSettings)
    if not isinstance(stream, PositionStream) or not len(stream.t):
        return Summary()
    settings = settings or PositionSettings()
    t, places = stream.t + settings.time_offset, np.column_stack((stream.x, stream.y))
    line, entries = f"{len(t)} positions", {"count": float(len(t))}
    if log.reference is not None:
        poses = log.reference.at(t, max_gap=MAX_GAP)
        away = np.hypot(*(se2.transform_from(poses, np.array((settings.x, settings.y))) - places).T)
        if np.isfinite(away).any():
            entries["median_error"] = float(np.nanmedian(away))
            line += f", {entries['median_error']:.2f} m from the reference (median)"
    problems = []
    implausible = np.isfinite(stream.var_x) & ~are_plausible(stream.var_x, stream.cov_xy, stream.var_y)
    if implausible.any():
        sentence = "{wrong} of {count} positions have an implausible covariance: position.sigma is used for them"
        problems.append(notice("implausible_variance", sentence, np.count_nonzero(implausible), len(t)))
    repeated = int(np.count_nonzero((np.diff(places, axis=0) == 0.0).all(axis=1)))
    if repeated > len(t) / 2:
        sentence = "{repeated} of {count} positions repeat the previous one and are not used"
        problems.append(notice("repeated_positions", sentence, repeated, len(t)))
    ratio = _ratio(log, t, places)
    if ratio is not None and ratio < SMALL:
        sentence = (
            "the positions travel {ratio:.1g} times as much as the odometry: they may be constant, or not in metres"
        )
        problems.append(notice("small_positions", sentence, ratio))
    return Summary({"position": entries}, problems=problems, text=[Paragraph(line)])


def _ratio(log: Log, t: Array, places: Array) -> float | None:
    """Return the median ratio, over time spans, of the distance by positions to the distance by odometry. Returns None
    if the robot hardly moves. ``places`` (N, 2): the measured positions [m] at the times ``t`` (N,) [s]."""
    stream = log.streams.get("odometry")
    if not isinstance(stream, VelocityStream | IncrementStream) or len(stream.t) < 2:
        return None
    order = np.argsort(t)
    at = np.arange(max(t.min(), stream.t[0]), min(t.max(), stream.t[-1]), SPAN)
    if len(at) < 2:
        return None
    states = integrated(log, odometry_model(log.rig)).states(at)
    ours = np.hypot(*np.diff(states[:, 1:3], axis=0).T)
    theirs = np.hypot(*np.diff([np.interp(at, t[order], column[order]) for column in places.T], axis=1))
    moving = ours > DRIVEN
    return float(np.median(theirs[moving] / ours[moving])) if moving.any() else None

"""Summarises the landmarks of a log, warns about problems of sightings and map, and checks a log before a run.

If the log has a reference, the position of each landmark is estimated from its sightings at the reference poses. The
method is the median of positions by range and bearing, or robust trilateration if there are only ranges. A landmark far
from its map position is a suspect. Time shifts are also tried between sightings and reference.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.checks import ROUNDING
from factorgraph_loc.fitting.posterior import MAD_TO_SIGMA
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors import interfaces
from factorgraph_loc.sensors.interfaces import (
    BETTER,
    FEWEST,
    LARGE,
    SHIFTS,
    SLOWEST,
    STEP,
    Marks,
    Summary,
    Use,
    in_other_case,
)
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings, BearingRangeStream, points_of
from factorgraph_loc.text import Notice, listed, notice
from factors import se2
from factors.landmarks import model as bearing_range
from factors.se2 import Array

UNKNOWN_LANDMARK = "landmark {landmark} is not in the map: {sightings} sightings"
MIN_SIGHTINGS = 10  # minimum number of sightings to judge the position of a landmark
MIN_OFFSET = 0.5  # m; smaller survey errors are harmless for robust estimators
PASS = 10.0  # s; the sightings in an interval of this length count as one, because their errors are correlated
MIN_PASSES = 3  # minimum number of intervals of length PASS with sightings to judge the position of a landmark
MOST = 2000  # maximum number of sightings for the estimate of a time shift
TALL = 0.5  # m; minimum difference of heights that is reported
MOUNTING = (0.5, 0.0, 0.0, 0.0)  # initial height, x, y [m] and rotation [rad] for the fit of the sensor's mounting
_REFERENCE_GAP = 0.1  # s; longest interpolated gap between reference poses


@dataclass(frozen=True)
class Suspect:
    """A landmark with a probably wrong position in the map.

    ``offset`` (2,) [m]: the position from sightings minus the position in the map. ``sightings``: number of sightings.
    ``swapped_with``: the name of a landmark that seems to be interchanged with this one in the map, or None.
    """

    landmark: str
    offset: Array
    sightings: int
    swapped_with: str | None = None

    def warning(self) -> Notice:
        """Return a warning about the position of this landmark."""
        sentence = "landmark {landmark}: {sightings} sightings put it {distance:.2f} m from its position in the map"
        values = self.landmark, self.sightings, np.hypot(*self.offset)
        if self.swapped_with:
            return notice("misplaced_landmark", sentence + "; swapped with {other}?", *values, self.swapped_with)
        return notice("misplaced_landmark", sentence, *values)


def summarize(log: Log) -> Summary:
    """Return the summary of the landmarks in a log, with warnings and these entries:

    - ``unseen``: names of mapped landmarks without sightings.
    - ``unknown``: the number of sightings of each name that is not in the map.
    - ``suspects``: landmarks that are probably at a wrong position in the map, see :class:`Suspect`.
    """
    unseen, unknown = _unmatched(log)
    suspects = find_suspects(log)
    other_case = "landmark {landmark} is in the map with other upper and lower case letters"
    problems = [
        *_shifted(log),
        *(notice("unknown_landmarks", UNKNOWN_LANDMARK, name, count) for name, count in unknown.items()),
        *(notice("other_case", other_case, name) for name in in_other_case(unknown, unseen)),
        *(suspect.warning() for suspect in suspects),
    ]
    entries = {"unseen": unseen, "unknown": unknown, "suspects": suspects}
    undetected = [notice("unseen_landmark", "landmark {landmark} of the map is never seen", name) for name in unseen]
    return Summary(entries, {"landmarks": len(log.world.landmarks)}, problems, undetected=undetected)


def find_suspects(log: Log) -> tuple[Suspect, ...]:
    """Return the landmarks with a probably wrong position in the map. Their position by sightings from reference poses
    differs by more than ``MIN_OFFSET`` [m] and by more than five standard errors. Returns () without a reference."""
    implied: dict[str, tuple[Array, int]] = {}
    for name, sightings in _seen_from_reference(log).items():
        passes = len(np.unique(sightings.t // PASS))
        if len(sightings.t) < MIN_SIGHTINGS or passes < MIN_PASSES:
            continue
        place = _place(log.world, name)
        position, scatter = _by_range_and_bearing(sightings) if sightings.has_bearing else _by_range(sightings, place)
        if _distance(position, place) > max(MIN_OFFSET, 5.0 * scatter / np.sqrt(passes)):
            implied[name] = (position, len(sightings.t))
    return tuple(
        Suspect(name, position - _place(log.world, name), count, _partner(log.world, name, implied))
        for name, (position, count) in implied.items()
    )


@dataclass(frozen=True)
class _Seen:
    """N sightings of one landmark from reference poses.

    ``t`` (N,): times [s]. ``sensors`` (N, 3): poses of the sensor in the world frame. ``ranges`` (N,): calibrated
    ranges [m], projected on the floor. ``bearings`` (N,): calibrated bearings [rad], NaN if not measured.
    """

    t: Array
    sensors: Array
    ranges: Array
    bearings: Array

    @property
    def has_bearing(self) -> bool:
        return bool(np.isfinite(self.bearings).any())


def _seen_from_reference(log: Log) -> dict[str, _Seen]:
    """Return the sightings of each mapped landmark, by its name. Sightings without a range or without a reference pose
    are omitted. Returns {} without a reference, sightings or landmark sensor."""
    stream = log.streams.get("bearing_range")
    if (
        log.reference is None
        or log.rig.find(BearingRangeSettings) is None
        or not isinstance(stream, BearingRangeStream)
    ):
        return {}
    settings = log.rig.of(BearingRangeSettings)
    model, t = settings.model(), stream.t + log.rig.time_offset("bearing_range")
    sensors = se2.compose(log.reference.at(t, max_gap=_REFERENCE_GAP + ROUNDING), np.array(model.mounting))
    ranges = stream.range / model.range_scale
    bearings = stream.bearing - model.bearing_bias
    if not log.reference.has_heading:
        bearings = np.full_like(bearings, np.nan)
    names = np.array(stream.landmark, dtype=str)
    usable = np.isfinite(sensors[:, :2]).all(axis=1) & np.isfinite(ranges)
    out = {}
    for name, mark in log.world.landmarks.items():
        rows = usable & (names == name)
        along_floor = np.sqrt(np.maximum(np.square(ranges[rows]) - (mark.z - settings.z) ** 2, 0.0))
        out[name] = _Seen(t[rows], sensors[rows], along_floor, bearings[rows])
    return out


def _by_range_and_bearing(sightings: _Seen) -> tuple[Array, float]:
    """Return the median (2,) of landmark positions from single sightings, and their robust standard deviation [m]."""
    rows = np.isfinite(sightings.bearings)
    direction = sightings.sensors[rows, 2] + sightings.bearings[rows]
    points = sightings.sensors[rows, :2] + sightings.ranges[rows, None] * np.stack(
        (np.cos(direction), np.sin(direction)), axis=-1
    )
    centre = np.median(points, axis=0)
    return centre, MAD_TO_SIGMA * float(np.median(np.hypot(*(points - centre).T)))


def _by_range(sightings: _Seen, place: Array) -> tuple[Array, float]:
    """Return the position (2,) of a landmark by robust trilateration, and the standard deviation [m] of a position from
    one sighting. ``place`` (2,): the initial position."""

    def residual(point: Array) -> Array:
        away: Array = sightings.sensors[:, :2] - point
        return np.hypot(away[:, 0], away[:, 1]) - sightings.ranges

    scale = max(MAD_TO_SIGMA * float(np.median(np.abs(residual(place)))), 1e-3)
    fit = scipy.optimize.least_squares(residual, place, loss="soft_l1", f_scale=scale)
    scale = max(MAD_TO_SIGMA * float(np.median(np.abs(fit.fun))), 1e-3)
    fit = scipy.optimize.least_squares(residual, fit.x, loss="cauchy", f_scale=scale)
    information = fit.jac.T @ fit.jac / len(sightings.t)
    weakest = max(float(np.linalg.eigvalsh(information)[0]), 1e-9)
    return fit.x, MAD_TO_SIGMA * float(np.median(np.abs(fit.fun))) / np.sqrt(weakest)


def _partner(world: World, name: str, implied: Mapping[str, tuple[Array, int]]) -> str | None:
    """Return the landmark that seems to be interchanged with ``name`` in the map, or None. ``implied``: the position
    (2,) of each suspect from sightings, and its number of sightings."""
    for candidate in implied:
        if candidate != name:
            mine, theirs = _place(world, name), _place(world, candidate)
            at, other_at = implied[name][0], implied[candidate][0]
            if _distance(at, theirs) < _distance(at, mine) and _distance(other_at, mine) < _distance(other_at, theirs):
                return candidate
    return None


def _place(world: World, name: str) -> Array:
    landmark = world.landmarks[name]
    return np.array((landmark.x, landmark.y))


def _distance(a: Array, b: Array) -> float:
    return float(np.hypot(*(a - b)))


def _unmatched(log: Log) -> tuple[tuple[str, ...], dict[str, int]]:
    """Return the names of mapped landmarks without sightings, and the number of sightings of each name that is not in
    the map."""
    stream = log.streams.get("bearing_range")
    if not isinstance(stream, BearingRangeStream):
        return (), {}
    counts = Counter(stream.landmark)
    unseen = tuple(name for name in log.world.landmarks if name not in counts)
    return unseen, {name: count for name, count in sorted(counts.items()) if name not in log.world.landmarks}


def _shifted(log: Log) -> list[Notice]:
    """Return a list with a warning if a time shift or another height of the landmarks clearly improves the agreement of
    sightings and reference. Returns [] otherwise."""
    stream, reference = log.streams.get("bearing_range"), log.reference
    if not isinstance(stream, BearingRangeStream) or reference is None or log.rig.find(BearingRangeSettings) is None:
        return []
    if len(reference.t) < 2 or float(np.median(np.diff(reference.t))) > SLOWEST:
        return []
    rows = np.array([i for i, name in enumerate(stream.landmark) if name in log.world.landmarks], dtype=np.int64)
    if len(rows) < FEWEST:
        return []
    rows = rows[:: max(1, len(rows) // MOST)]
    settings, t = log.rig.of(BearingRangeSettings), stream.t[rows] + log.rig.time_offset("bearing_range")
    places = points_of((log.world.landmarks[stream.landmark[i]] for i in rows.tolist()), settings.z)
    model = settings.model()

    def errors(shift: float, height: float = 0.0, x: float = 0.0, y: float = 0.0, turn: float = 0.0) -> Array:
        """Return range and bearing errors (N, 2) in standard deviations, NaN if unknown. ``shift``: the time shift [s].
        ``height``: the height of the landmarks above the sensor [m]. ``x``, ``y`` [m], ``turn`` [rad]: changes of the
        sensor's pose on the robot."""
        mounted = replace(model, mounting=tuple(np.add(model.mounting, (x, y, turn)).tolist()))
        ranges, bearings = bearing_range.predict(mounted, reference.at(t - shift, max_gap=3.0 * SLOWEST), places)
        far = (np.hypot(ranges, height) - stream.range[rows]) / model.range_sigma
        aside = se2.wrap(bearings - stream.bearing[rows]) / model.bearing_sigma
        return np.column_stack((far, aside if reference.has_heading else np.full_like(far, np.nan)))

    def fitted(shift: float) -> tuple[float, float]:
        """Return :func:`_cost` with the best pose of the sensor and the best height, and the absolute height [m].
        ``shift``: the time shift [s]."""
        start = np.array(MOUNTING if reference.has_heading else MOUNTING[:1])
        fit = scipy.optimize.least_squares(
            lambda mounting: np.nan_to_num(errors(shift, *mounting)).ravel(), start, loss="soft_l1"
        )
        return _cost(errors(shift, *fit.x.tolist())), abs(float(fit.x[0]))

    shifts = (STEP * SHIFTS).tolist()
    best, (cost, height) = min(shifts, key=lambda shift: _cost(errors(shift))), fitted(0.0)
    name = stream.source or "bearing_range"
    if abs(best) >= LARGE and fitted(best)[0] < BETTER * cost:
        return [interfaces.line(name, best, "the reference", name, -best)]
    if height > TALL and _cost(errors(0.0, height)) < BETTER * _cost(errors(0.0)):
        sentence = (
            "ranges near landmarks are too long, as if the landmarks were {height:.1f} m above or below the sensor: give z of the "
            "landmarks, and {name}.z of the rig"
        )
        return [notice("height", sentence, height, name)]
    return []


def _cost(errors: Array) -> float:
    """Return the median absolute range error plus the median absolute bearing error. Columns with too few errors are
    ignored. Returns infinity if both columns are ignored. ``errors`` (N, 2): the errors, NaN if unknown."""
    usable = [kept for column in errors.T if len(kept := column[np.isfinite(column)]) >= FEWEST // 2]
    return sum(float(np.median(np.abs(kept))) for kept in usable) if usable else np.inf


def check(use: Use) -> Use:
    """Return ``use`` unchanged. Raises InputError if the estimator requires sightings with range and bearing to locate
    landmarks, and no sighting in the log has both."""
    log, wanted = use.log, getattr(use.settings, "landmarks", "known")
    streams = [stream for name, stream in _streams(log).items() if name in use.sensors and len(stream.t)]
    if wanted == "known" or use.estimates_points or not streams:
        return use
    if any(np.any(np.isfinite(stream.range) & np.isfinite(stream.bearing)) for stream in streams):
        return use
    if wanted == "extended" and any(name in log.world.landmarks for stream in streams for name in stream.landmark):
        return use
    lacks = "bearing" if any(np.any(np.isfinite(stream.range)) for stream in streams) else "range"
    name = use.estimator
    raise InputError(
        f"{log.name}: {name}.landmarks is {wanted}, but no sighting has a {lacks}, and {name} needs range and bearing to locate a "
        f"landmark: use the smoother, or give a map (--world) with {name}.landmarks=known"
    )


def _streams(log: Log) -> dict[str, BearingRangeStream]:
    """Return the streams of sightings in a log, by the name of the sensor."""
    return {name: stream for name, stream in log.streams.items() if isinstance(stream, BearingRangeStream)}


def draw(log: Log) -> Marks:
    """Return the landmarks of the map and the times of their sightings in ``log``, for plots and viewers."""
    places = log.world.positions()
    positions = np.column_stack((places, np.zeros(len(places))))
    stream = log.streams.get("bearing_range")
    t, names = np.empty(0), tuple[str, ...]()
    if isinstance(stream, BearingRangeStream):
        t, names = stream.t + log.rig.time_offset("bearing_range"), tuple(stream.landmark)
    return Marks("landmarks", tuple(log.world.landmarks), positions, t, names, marker="^", size=7.0, order=4.0)


def require_mappable(log: Log) -> None:
    """Raise InputError if the log has no sightings of landmarks, or if its rig has no landmark sensor."""
    streams = [stream for stream in _streams(log).values() if len(stream.t)]
    if not streams:
        raise InputError(f"{log.name}: has no sightings of landmarks (bearing_range), so there is nothing to map")
    if not log.rig.names("bearing_range"):
        raise InputError(f"{log.name}: its rig has no section [bearing_range]: add it with noise and mounting")


def detected(log: Log) -> Counter[str]:
    """Return the number of sightings of each landmark in a log, by its name."""
    return Counter(name for stream in _streams(log).values() for name in stream.landmark)


def not_located(log: Log, located: Container[str]) -> list[Notice]:
    """Return a list with a warning about sighted landmarks that are not in ``located``, or [] if all are in it."""
    missing = [f"{name} ({count} sightings)" for name, count in sorted(detected(log).items()) if name not in located]
    return (
        [notice("not_located", "landmarks that were sighted but could not be located: {landmarks}", listed(missing))]
        if missing
        else []
    )

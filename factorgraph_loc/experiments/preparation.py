"""Preparation of a run: the prior of its start pose, its sensors, and checks by the packages of the sensors."""

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, nearest
from factorgraph_loc.fusion import registry
from factorgraph_loc.model.belief import EXACT_SIGMA, HEADING_SIGMA, POSITION_SIGMA, PosePrior
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.scoring import parse_position
from factorgraph_loc.model.sections import kind_of
from factorgraph_loc.sensors.interfaces import Use, lacking_section
from factorgraph_loc.sensors.registry import channels, functions, moving, parent_of
from factorgraph_loc.text import Notice, listed, notice, quoted

# standard deviations of a start pose that is a pose of the reference
REFERENCE_POSITION_SIGMA = 0.02  # m
REFERENCE_HEADING_SIGMA = 0.01  # rad
SET_PRIOR = "set the prior (--prior) to"  # last part of messages about the start pose


def resolve_prior(log: Log, prior: str | None) -> tuple[PosePrior | None, str]:
    """Return the Gaussian prior of the start pose of a run (None if the start is unknown), and the name of its source.

    ``prior`` is one of these:

    - "reference": the first pose of the reference at or after the first odometry, with standard deviations of 0.02 m
      and 0.01 rad. If the reference has no headings, the heading is unknown.
    - "log": the start pose in the log.
    - "X,Y,HEADING" [m, m, rad]: a pose at the first odometry, with standard deviations of 0.05 m and 0.05 rad.
    - "X,Y" [m]: a position at the first odometry, with unknown heading.
    - "unknown": an unknown start.
    - None: the log's start, or the reference if the log has none, or an unknown start if there is no reference.

    Raises InputError if the log has no such start, or ``prior`` is none of these.
    """
    if prior is None:
        prior = "log" if log.start is not None else "unknown" if log.reference is None else "reference"
    if prior == "unknown":
        return None, prior
    if prior == "log":
        if log.start is None:
            raise InputError(
                f"{log.name}: has no start pose: {SET_PRIOR} 'reference', 'X,Y,HEADING', 'X,Y' or 'unknown'"
            )
        return PosePrior(log.start.t, np.array(log.start.pose), np.diag(np.square(log.start.sigmas))), prior
    if prior == "reference":
        return _from_reference(log), prior
    pose, covariance = np.array(parse_position(prior)), _covariance(POSITION_SIGMA, HEADING_SIGMA)
    if len(pose) == 2:
        return PosePrior.at_position(first_odometry(log), pose, covariance[:2, :2]), prior
    return PosePrior(first_odometry(log), pose, covariance), prior


def at_origin(log: Log) -> PosePrior:
    """Return an exact prior of the pose (0, 0, 0) at the first odometry, where the start defines the frame."""
    return PosePrior(first_odometry(log), np.zeros(3), _covariance(EXACT_SIGMA, EXACT_SIGMA))


def first_odometry(log: Log) -> float:
    """Return the time [s] of the first odometry, or of the first measurement if there is no odometry. The time offset
    of the sensor in the rig is added."""
    starts = [
        float(t.min()) + log.rig.time_offset(name) for name in moving(log.streams) if len(t := log.streams[name].t)
    ]
    return min(starts, default=log.span()[0])


def _from_reference(log: Log) -> PosePrior:
    """Return a prior at the first reference pose at or after the first odometry. Raises InputError if there is none."""
    if log.reference is None:
        raise InputError(
            f"{log.name}: has no reference to start from: {SET_PRIOR} 'log', 'X,Y,HEADING', 'X,Y' or 'unknown'"
        )
    start = first_odometry(log)
    first = int(np.searchsorted(log.reference.t, start))
    if first == len(log.reference):
        raise InputError(
            f"{log.name}: its reference ends before the first odometry at {start:.3f} s: {SET_PRIOR} 'X,Y,HEADING' or 'unknown'"
        )
    t, pose = float(log.reference.t[first]), np.array(log.reference.poses[first])
    covariance = _covariance(REFERENCE_POSITION_SIGMA, REFERENCE_HEADING_SIGMA)
    if not log.reference.has_heading:
        return PosePrior.at_position(t, pose[:2], covariance[:2, :2])
    return PosePrior(t, pose, covariance)


def _covariance(position_sigma: float, heading_sigma: float) -> np.typing.NDArray[np.float64]:
    """Return the covariance (3, 3) of a pose (x, y, heading) from standard deviations [m, rad]."""
    return np.diag(np.square((position_sigma, position_sigma, heading_sigma)))


def columns_of(streams: Iterable[str]) -> tuple[str, ...]:
    """Return the names of sensors that are optional columns of ``streams``, such as ``rssi`` of RFID reads."""
    available = set(streams)
    return tuple(name for name in channels() if parent_of(name) in available)


def used_sensors(log: Log, asked: tuple[str, ...] | None) -> tuple[str, ...]:
    """Return the names of the sensors that a run uses.

    ``asked``: the requested sensors. If it is None, all sensors of the rig with measurements in the log are used.
    Raises InputError if a requested sensor is not available, or if no sensor is available.
    """
    available = (*log.streams, *_filled_columns(log))
    asked = None if asked is None else log.rig.expanded(asked)
    for sensor in asked or ():
        parent = parent_of(sensor)
        if parent and parent not in (asked or ()):
            raise InputError(f"{log.name}: {sensor} is a column of {parent}: add {parent} to the sensors (--sensors)")
        if parent and sensor not in available:
            raise InputError(f"{log.name}: has no sensor {quoted(sensor)}: this column of {parent} is missing or empty")
        if sensor not in available:
            raise InputError(f"{log.name}: has no sensor {quoted(sensor)}{nearest(sensor, list(available))}")
        if section := lacking_section(log.rig, sensor):
            raise InputError(f"{log.name}: {sensor} needs [{section}] in the rig, and {log.rig.name} has none")
    sensors = tuple(
        s for s in (log.rig.sensors if asked is None else asked) if s in available and not lacking_section(log.rig, s)
    )
    if not log.streams:
        raise InputError(f"{log.name}: has a reference but no measurements, expected odometry at least")
    if not sensors:
        raise InputError(
            f"{log.name}: has none of the rig's sensors {listed(log.rig.sensors)}{nearest('', list(available))}"
        )
    return sensors


def unused(log: Log, sensors: tuple[str, ...]) -> tuple[Notice, ...]:
    """Return warnings about sensors of the rig that cannot be used, and a warning if ``sensors`` have no odometry.
    ``sensors``: names of the used sensors."""
    available = (*log.streams, *_filled_columns(log))
    sentence = "{log}: the rig lists the sensor {sensor}, the log has none"
    doubts = [notice("no_stream", sentence, log.name, s) for s in log.rig.sensors if s not in available]
    kinds = {kind_of(sensor) for sensor in log.rig.sensors}
    lacking = {s: section for s in log.streams if kind_of(s) in kinds and (section := lacking_section(log.rig, s))}
    for section in dict.fromkeys(lacking.values()):
        names = ", ".join(name for name, of in lacking.items() if of == section)
        sentence = "{log}: {sensors} not used, because the rig {rig} has no [{section}]"
        doubts.append(notice("no_section", sentence, log.name, names, log.rig.name, section))
    if not moving(sensors):
        sentence = "{log}: run without odometry, the motion between measurements is unknown"
        doubts.append(notice("no_odometry", sentence, log.name))
    return tuple(doubts)


def use_of(log: Log, sensors: Sequence[str], estimator: str, settings: FileModel, given: Collection[str] = ()) -> Use:
    """Return the log, sensors, estimator and settings of a run as one object, which :func:`checked_use` needs.

    ``sensors``: names of the used sensors. ``estimator``: its name. ``given``: names of the settings that the user has
    set.
    """
    kind = registry.estimator_type(estimator)
    modalities = getattr(kind, "modalities", frozenset[str]())
    return Use(log, tuple(sensors), estimator, settings, modalities, getattr(kind, "estimates_points", False), given)


def checked_use(use: Use) -> Use:
    """Return ``use``, the description of a run, after the checks of all sensor packages. A check compares the settings
    with the log. It may change the settings and add warnings. Raises InputError if a setting does not fit the log."""
    for _, check in functions("check"):
        use = check(use)
    return use


def _filled_columns(log: Log) -> tuple[str, ...]:
    """Return the names of optional columns (:func:`columns_of`) that have a value in any row of the log."""
    names = columns_of(log.streams)
    return tuple(n for n in names if np.any(np.isfinite(getattr(log.streams[parent_of(n)], n, np.nan))))

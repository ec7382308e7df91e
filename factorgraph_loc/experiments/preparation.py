"""Preparation of a run: its start (of the user, the log or the reference), its sensors, and the preparation by their packages."""

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, nearest
from factorgraph_loc.fusion import registry
from factorgraph_loc.model.belief import EXACT_SIGMA, HEADING_SIGMA, POSITION_SIGMA, PosePrior
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.scoring import PRIORS, parse_position
from factorgraph_loc.model.sections import kind_of
from factorgraph_loc.sensors.interfaces import Use, lacking_section
from factorgraph_loc.sensors.registry import channels, functions, moving, parent_of
from factorgraph_loc.text import Notice, listed, notice, quoted

# of a start taken from the reference
REFERENCE_POSITION_SIGMA = 0.02  # m
REFERENCE_HEADING_SIGMA = 0.01  # rad


def resolve_prior(log: Log, prior: str | None) -> tuple[PosePrior | None, str]:
    """The Gaussian prior of the start of a run, and the name of its source.

    ``prior``: ``reference`` (the first reference pose at or after the first odometry, 0.02 m and 0.01 rad), ``log`` (the start
    stated by the log), ``X,Y,HEADING`` [m, m, rad] (at the first odometry, 0.05 m and 0.05 rad), ``X,Y`` with unknown heading, or
    ``unknown``. None: the log's start, else the reference, else unknown. An unknown start is returned as None. For a reference
    without headings, the heading is unknown too.

    Raises InputError if the log lacks what is requested, or ``prior`` is none of these.
    """
    if prior is None:
        prior = "log" if log.start is not None else "unknown" if log.reference is None else "reference"
    if prior == "unknown":
        return None, prior
    if prior == "log":
        if log.start is None:
            raise InputError(f"{log.name}: states no start, expected a prior {PRIORS}")
        return PosePrior(log.start.t, np.array(log.start.pose), np.diag(np.square(log.start.sigmas))), prior
    if prior == "reference":
        return _from_reference(log), prior
    pose, covariance = np.array(parse_position(prior)), _covariance(POSITION_SIGMA, HEADING_SIGMA)
    if len(pose) == 2:
        return PosePrior.at_position(first_odometry(log), pose, covariance[:2, :2]), prior
    return PosePrior(first_odometry(log), pose, covariance), prior


def at_origin(log: Log) -> PosePrior:
    """The start (0, 0, 0) of a log without other information, at the first odometry: exact, as it defines the frame."""
    return PosePrior(first_odometry(log), np.zeros(3), _covariance(EXACT_SIGMA, EXACT_SIGMA))


def first_odometry(log: Log) -> float:
    """Stamp of the first odometry [s], clock offset applied; of the first measurement if there is no odometry."""
    starts = [
        float(t.min()) + log.rig.time_offset(name) for name in moving(log.streams) if len(t := log.streams[name].t)
    ]
    return min(starts, default=log.span()[0])


def _from_reference(log: Log) -> PosePrior:
    if log.reference is None:
        raise InputError(f"{log.name}: has no reference to start from, expected a prior {PRIORS}")
    start = first_odometry(log)
    first = int(np.searchsorted(log.reference.t, start))
    if first == len(log.reference):
        raise InputError(
            f"{log.name}: its reference ends before the first odometry at {start:.3f} s, choose another prior"
        )
    t, pose = float(log.reference.t[first]), np.array(log.reference.poses[first])
    covariance = _covariance(REFERENCE_POSITION_SIGMA, REFERENCE_HEADING_SIGMA)
    if not log.reference.has_heading:
        return PosePrior.at_position(t, pose[:2], covariance[:2, :2])
    return PosePrior(t, pose, covariance)


def _covariance(position_sigma: float, heading_sigma: float) -> np.typing.NDArray[np.float64]:
    return np.diag(np.square((position_sigma, position_sigma, heading_sigma)))


def columns_of(streams: Iterable[str]) -> tuple[str, ...]:
    """The channels that are columns of ``streams``."""
    available = set(streams)
    return tuple(name for name in channels() if parent_of(name) in available)


def used_sensors(log: Log, asked: tuple[str, ...] | None) -> tuple[str, ...]:
    """The sensors to use: those of the rig that the log has, or ``asked``, which must be available."""
    available = (*log.streams, *_filled_columns(log))
    asked = None if asked is None else log.rig.expanded(asked)
    for sensor in asked or ():
        parent = parent_of(sensor)
        if parent and parent not in (asked or ()):
            raise InputError(f"{log.name}: {sensor} is a column of {parent}, expected {parent} among the sensors too")
        if parent and sensor not in available:
            raise InputError(f"{log.name}: has no sensor {quoted(sensor)}: no row of {parent} has a value of it")
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
    """Warnings about unusable sensors of the rig, and about missing odometry."""
    available = (*log.streams, *_filled_columns(log))
    sentence = "{log}: the rig lists the sensor {sensor}, the log has none"
    doubts = [notice("no_stream", sentence, log.name, s) for s in log.rig.sensors if s not in available]
    kinds = {kind_of(sensor) for sensor in log.rig.sensors}
    lacking = {s: section for s in log.streams if kind_of(s) in kinds and (section := lacking_section(log.rig, s))}
    for section in dict.fromkeys(lacking.values()):
        names = ", ".join(name for name, of in lacking.items() if of == section)
        sentence = "{log}: {sensors} left out, as the rig {rig} has no [{section}]"
        doubts.append(notice("no_section", sentence, log.name, names, log.rig.name, section))
    if not moving(sensors):
        sentence = "{log}: run without odometry, the motion between measurements is unknown"
        doubts.append(notice("no_odometry", sentence, log.name))
    return tuple(doubts)


def use_of(log: Log, sensors: Sequence[str], estimator: str, settings: FileModel, given: Collection[str] = ()) -> Use:
    """The description of a run for the sensors' packages; ``given``: the settings that the user has set."""
    kind = registry.estimator_type(estimator)
    modalities = getattr(kind, "modalities", frozenset[str]())
    return Use(log, tuple(sensors), estimator, settings, modalities, getattr(kind, "estimates_points", False), given)


def checked_use(use: Use) -> Use:
    """The run with the settings that its sensors require of it; InputError if log and settings do not fit."""
    for _, check in functions("check"):
        use = check(use)
    return use


def _filled_columns(log: Log) -> tuple[str, ...]:
    """The columns that have a value in any row of the log."""
    names = columns_of(log.streams)
    return tuple(n for n in names if np.any(np.isfinite(getattr(log.streams[parent_of(n)], n, np.nan))))

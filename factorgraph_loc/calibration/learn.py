"""A rig learnt from logs with reference poses, before any estimator runs: constants, noise, scatter."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from factorgraph_loc.calibration.constants import UNCERTAIN, Learnt, describe
from factorgraph_loc.errors import InputError
from factorgraph_loc.fitting.robust import Constant, Fit, folds, gains, is_worth
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.landmarks import calibration as sightings
from factorgraph_loc.sensors.landmarks.calibration import Correlation, Sightings
from factorgraph_loc.sensors.landmarks.settings import BearingRangeSettings
from factorgraph_loc.sensors.odometry.calibration import constants as odometry
from factorgraph_loc.sensors.odometry.calibration.noise import NoiseFit, fit_noise
from factorgraph_loc.sensors.odometry.calibration.windows import Windows, cut
from factorgraph_loc.sensors.odometry.model import odometry_model
from factorgraph_loc.sensors.odometry.settings import GrowthSettings, OdometryNoise
from factorgraph_loc.sensors.rfid.calibration.choice import Kind
from factorgraph_loc.sensors.rfid.calibration.learn import RfidKnowledge, learn_rfid
from factors.se2 import Array

MIN_WINDOWS = 20
MIN_SIGHTINGS = 100
MOST_SIGHTINGS = 12000  # of a log that have a part in fits
BLOCKS = 5  # stretches of time of a single log, each predicted by the others
BETTER_KIND = (
    0.9  # ranges are taken to be of the other kind, distance or depth, if then their spread is below this share
)
ROUNDS = 2  # of constants and scatter in turn
EXTEROCEPTIVE = ("bearing_range", "rfid")  # what a robot knows its place by
RANGE_KIND = "bearing_range.range_kind"
FIRST_SENSOR = BearingRangeSettings(range_sigma=0.1)  # of which nothing is known


@dataclass(frozen=True)
class Knowledge:
    """What the logs say. ``rig`` has the scatter as noise; ``noise`` is None where the reference has no heading.

    ``windows``: of 2 s, by log; ``seen``: by log, none without landmarks; ``rfid``: None without reads of tags; ``notes``: what
    could not be learnt, one line each. ``wheels`` and ``sensor``: the fits that the constants are chosen from.
    """

    rig: Rig
    constants: tuple[Learnt, ...]
    noise: NoiseFit | None
    windows: tuple[Windows, ...]
    seen: tuple[Sightings, ...]
    correlations: tuple[Correlation, ...]
    notes: tuple[str, ...]
    rfid: RfidKnowledge | None = None
    wheels: WheelsFit | None = None
    sensor: SensorFit | None = None


@dataclass(frozen=True)
class WheelsFit:
    """All constants of the odometry fitted together, from ``start`` and with ``sigmas`` (3,) of the residuals; ``gain`` (P, K): see
    :func:`~factorgraph_loc.fitting.robust.gains`; ``denied``: names of those that windows at rest deny."""

    everything: Fit
    gain: Array
    denied: tuple[str, ...]
    sigmas: Array
    start: Mapping[str, float]


@dataclass(frozen=True)
class SensorFit:
    """All constants of the landmark sensor fitted together to the sightings ``seen``; ``settings``: with these and their scatter,
    of the kind of ranges that fits best. ``gain`` as of :class:`WheelsFit`."""

    everything: Fit
    gain: Array
    settings: BearingRangeSettings
    seen: tuple[Sightings, ...]


def learn(
    logs: Sequence[Log],
    rig: Rig,
    grids: Path | None = None,
    rfid_kind: Kind | None = None,
    *,
    by_log: bool = True,
) -> Knowledge:
    """The rig that ``logs`` tell, starting from ``rig``, whose values stay where a log cannot tell them better.

    ``grids`` and ``rfid_kind``: see :func:`~factorgraph_loc.sensors.rfid.calibration.learn.learn_rfid`; for logs with reads of
    tags. ``by_log``: see :func:`settled`. Raises InputError if a log is too short.
    """
    logs = [replace(log, rig=rig) for log in logs]
    windows: tuple[Windows, ...] = ()
    wheels: WheelsFit | None = None
    if has_heading(logs[0]):
        windows = tuple(cut(log, odometry.WINDOW) for log in logs)
        for one in windows:
            if len(one.begin) < MIN_WINDOWS:
                raise InputError(
                    f"{one.log.name}: odometry and reference overlap in {len(one.begin)} windows of {odometry.WINDOW:g} s, "
                    f"expected {MIN_WINDOWS} or more"
                )
        wheels = _fit_wheels(windows, rig)
    seen: tuple[Sightings, ...] = ()
    sensor: SensorFit | None = None
    if "bearing_range" in logs[0].streams:
        seen = tuple(sightings_with(log) for log in logs)
        sensor = _fit_sightings(seen, rig.bearing_range or FIRST_SENSOR)
    learnt, rfid = rig, None
    if "rfid" in logs[0].streams:
        if grids is None:
            raise ValueError("logs with reads of tags need a place for grids")
        learnt, rfid = learn_rfid(logs, rig, grids, rfid_kind)
    knowledge = Knowledge(learnt, (), None, windows, seen, (), (), rfid, wheels, sensor)
    return settled(knowledge, logs, rig, by_log=by_log)


def settled(
    knowledge: Knowledge,
    logs: Sequence[Log],
    rig: Rig,
    accepted: Collection[str] | None = None,
    *,
    by_log: bool = True,
) -> Knowledge:
    """What is learnt of wheels and landmark sensor with those constants alone that are worth it and ``accepted``, by their names
    with the sensor's; None: all that are worth it.

    What depends on the constants, noise, scatter and uncertainty, is learnt for these. ``rig``: that with which ``logs`` came.
    Unless ``by_log``, no log is looked at alone: then there are neither uncertainties nor correlations.
    """
    logs = [replace(log, rig=rig) for log in logs]
    notes = []
    learnt: list[Learnt] = []
    noise: NoiseFit | None = None
    out = knowledge.rig.model_copy(update={"odometry": rig.odometry, "bearing_range": rig.bearing_range})
    if knowledge.wheels is not None:
        found, noise = _settle_wheels(knowledge.wheels, knowledge.windows, logs, rig, accepted, by_log=by_log)
        learnt += found
        out = _with_odometry(out, found, noise)
    else:
        notes.append(
            "The reference has no headings: of the constants only the range scale is learnt, the odometry stays."
        )
    correlations: tuple[Correlation, ...] = ()
    if knowledge.sensor is not None:
        found, sensor = _settle_sightings(knowledge.sensor, rig.bearing_range or FIRST_SENSOR, accepted, by_log=by_log)
        learnt += found
        if rig.bearing_range is not None and sensor.range_kind != rig.bearing_range.range_kind:
            notes.append(
                f"The ranges fit better as the {sensor.range_kind} than as the {rig.bearing_range.range_kind}."
            )
        out = out.model_copy(update={"bearing_range": sensor})
        correlations = tuple(sightings.correlation(one, sensor) for one in knowledge.seen if by_log)
    if len(logs) == 1:
        notes.append(
            "One log cannot tell what differs between runs: the uncertainties of constants are those of the input rig."
        )
    return replace(
        knowledge,
        rig=sensing(_uncertainties(out, learnt), logs[0]),
        constants=tuple(learnt),
        noise=noise,
        correlations=correlations,
        notes=tuple(notes),
    )


def sensing(rig: Rig, log: Log) -> Rig:
    """The rig with all exteroceptive sensors of the log, and none that the log lacks, among those that are used."""
    kept = [name for name in rig.sensors if name not in EXTEROCEPTIVE or name in log.streams]
    added = [name for name in EXTEROCEPTIVE if name in log.streams and name not in kept]
    return rig.model_copy(update={"sensors": (*kept, *added)})


def sightings_with(log: Log) -> Sightings:
    """The sightings of a log; InputError if they are too few."""
    seen = sightings.sightings_of(log)
    if len(seen.t) < MIN_SIGHTINGS:
        raise InputError(
            f"{log.name}: has {len(seen.t)} sightings of landmarks of the map while there is a reference, "
            f"expected {MIN_SIGHTINGS} or more"
        )
    return seen


def _fit_wheels(windows: Sequence[Windows], rig: Rig) -> WheelsFit:
    constants = odometry.constants_of(windows[0], rig.odometry)
    model = odometry_model(rig)
    start = {c.name: c.neutral for c in constants}
    start |= {name: max(start[name], odometry.LAGGING_START) for name in ("delay", "lag") if name in start}
    for _ in range(ROUNDS):
        sigmas = odometry.scatter(windows, odometry.with_constants(model, start))
        everything = odometry.fit_odometry(windows, model, constants, sigmas, start)
        start = everything.as_dict()
    denied = odometry.denied_at_rest(everything, windows)
    gain = gains(everything, folds([one.begin for one in windows], BLOCKS), denied)
    return WheelsFit(everything, gain, denied, sigmas, start)


def _settle_wheels(
    wheels: WheelsFit,
    windows: Sequence[Windows],
    logs: Sequence[Log],
    rig: Rig,
    accepted: Collection[str] | None,
    *,
    by_log: bool,
) -> tuple[list[Learnt], NoiseFit]:
    model, constants, sigmas, start = odometry_model(rig), wheels.everything.constants, wheels.sigmas, wheels.start
    kept = _kept("odometry", constants, wheels.gain, accepted)
    pooled = odometry.fit_odometry(windows, model, kept, sigmas, start) if kept else None
    model = odometry.with_constants(model, pooled.as_dict() if pooled else {})
    apart = _apart("odometry", constants, start, kept)
    parts = windows if len(windows) > 1 else windows[0].halves()
    alone = [
        {n: v for some in apart for n, v in odometry.fit_odometry([one], model, some, sigmas, start).as_dict().items()}
        for one in parts
        if by_log
    ]
    learnt = describe("odometry", wheels.everything, pooled, alone, wheels.gain, len(logs), wheels.denied)
    return learnt, fit_noise(logs, model)


def _fit_sightings(seen: Sequence[Sightings], before: BearingRangeSettings) -> SensorFit:
    seen = [one.thinned(MOST_SIGHTINGS) for one in seen]
    everything, settings = _fit_and_scatter(seen, before)
    if sightings.could_be_depths(seen):
        other = before.model_copy(update={"range_kind": "distance" if before.range_kind == "depth" else "depth"})
        found, changed = _fit_and_scatter(seen, other)
        if sightings.range_spread(seen, changed) < BETTER_KIND * sightings.range_spread(seen, settings):
            everything, settings = found, changed
    gain = gains(everything, folds([one.t for one in seen], BLOCKS))
    return SensorFit(everything, gain, settings, tuple(seen))


def _settle_sightings(
    sensor: SensorFit, before: BearingRangeSettings, accepted: Collection[str] | None, *, by_log: bool
) -> tuple[list[Learnt], BearingRangeSettings]:
    seen, constants, start = sensor.seen, sensor.everything.constants, sensor.everything.as_dict()
    kept = _kept("bearing_range", constants, sensor.gain, accepted)
    settings = sensor.settings.model_copy(update={c.name: c.neutral for c in constants})
    if accepted is not None and RANGE_KIND not in accepted:
        settings = settings.model_copy(update={"range_kind": before.range_kind})
    pooled = sightings.fit_sensor(seen, settings, kept, start) if kept else None
    settings = settings.model_copy(update=pooled.as_dict() if pooled else {})
    apart = _apart("bearing_range", constants, start, kept)
    parts = seen if len(seen) > 1 else seen[0].halves()
    alone = [
        {n: v for some in apart for n, v in sightings.fit_sensor([one], settings, some, start).as_dict().items()}
        for one in parts
        if by_log
    ]
    learnt = describe("bearing_range", sensor.everything, pooled, alone, sensor.gain, len(seen))
    return learnt, sightings.with_scatter(seen, settings)


def _kept(sensor: str, constants: Sequence[Constant], gain: Array, accepted: Collection[str] | None) -> list[Constant]:
    """Those that predict better what they were not fitted to, and are ``accepted``."""
    return [
        c
        for c, g in zip(constants, gain, strict=True)
        if is_worth(g) and (accepted is None or f"{sensor}.{c.name}" in accepted)
    ]


def _fit_and_scatter(seen: Sequence[Sightings], before: BearingRangeSettings) -> tuple[Fit, BearingRangeSettings]:
    """All constants of the sensor and its scatter, in turn."""
    constants = sightings.constants_of(seen, before)
    start = {c.name: c.neutral for c in constants}
    settings = sightings.with_scatter(seen, before)
    for _ in range(ROUNDS):
        everything = sightings.fit_sensor(seen, settings, constants, start)
        start = everything.as_dict()
        settings = sightings.with_scatter(seen, settings.model_copy(update=start))
    return everything, settings


def _apart(
    sensor: str, constants: Sequence[Constant], found: Mapping[str, float], kept: Sequence[Constant]
) -> list[list[Constant]]:
    """What is fitted to each log alone: what is kept with what an estimator could learn on each run, then what is kept.

    The values of the latter come from the second fit: what is not kept may do the same as what is.
    """
    kept = list(kept)
    learnable = [c for c in constants if c.name in UNCERTAIN[sensor] and c.is_inside(found[c.name]) and c not in kept]
    return [some for some in ([*kept, *learnable] if learnable else [], kept) if some]


def _with_odometry(rig: Rig, learnt: Sequence[Learnt], noise: NoiseFit) -> Rig:
    growth = {
        error: GrowthSettings.bounded(per_distance=g.per_distance, per_rotation=g.per_rotation, per_time=g.per_time)
        for error, g in noise.growth.items()
    }
    changed: dict[str, object] = {one.name: one.value for one in learnt}
    return rig.model_copy(
        update={"odometry": rig.odometry.model_copy(update=changed | {"noise": OdometryNoise(**growth)})}
    )


def _uncertainties(rig: Rig, learnt: Sequence[Learnt]) -> Rig:
    """The rig with what differs between logs, where there are several."""
    sections: dict[str, object] = {}
    for sensor, most in UNCERTAIN.items():
        settings = getattr(rig, sensor)
        if settings is None:
            continue
        found = {
            one.name: min(one.uncertainty, most[one.name])
            for one in learnt
            if one.sensor == sensor and one.uncertainty is not None
        }
        uncertainty = settings.uncertainty.model_copy(update=found)
        sections[sensor] = settings.model_copy(update={"uncertainty": uncertainty})
    return rig.model_copy(update=sections)


def has_heading(log: Log) -> bool:
    """Whether the log's reference has headings that mean something."""
    return log.reference is not None and log.reference.has_heading

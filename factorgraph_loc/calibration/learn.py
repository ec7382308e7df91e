"""A rig learnt from logs with reference poses, before any estimator runs: constants, noise, scatter."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factorgraph_loc.calibration import odometry, sightings
from factorgraph_loc.calibration.noise import NoiseFit, fit_noise
from factorgraph_loc.calibration.rfid_choice import Kind
from factorgraph_loc.calibration.rfid_learn import RfidKnowledge, learn_rfid
from factorgraph_loc.calibration.robust import Constant, Fit, folds, gains, is_worth
from factorgraph_loc.calibration.sightings import Correlation, Sightings
from factorgraph_loc.calibration.windows import Windows, cut
from factorgraph_loc.errors import InputError
from factorgraph_loc.log import Log
from factorgraph_loc.rig import BearingRangeSettings, GrowthSettings, OdometryNoise, Rig
from factors.se2 import Array

MIN_WINDOWS = 20
MIN_SIGHTINGS = 100
MOST_SIGHTINGS = 12000  # of a log that have a part in fits
BLOCKS = 5  # stretches of time of a single log, each predicted by the others
BETTER_KIND = (
    0.9  # ranges are taken to be of the other kind, distance or depth, if then their spread is below this share
)
ROUNDS = 2  # of constants and scatter in turn
# the constants that an estimator can learn on each run, with the most that the rig takes
UNCERTAIN: dict[str, dict[str, float]] = {
    "odometry": dict.fromkeys(("scale_distance", "scale_rotation", "heading_rate_bias", "heading_drift"), 1.0),
    "bearing_range": {"x": 10.0, "y": 10.0}
    | dict.fromkeys(("bearing_bias", "range_scale", "depth_axis", "time_offset"), 1.0),
}
EXTEROCEPTIVE = ("bearing_range", "rfid")  # what a robot knows its place by
_FIRST_SIGMA = 0.1  # m, of a sensor of which nothing is known


@dataclass(frozen=True)
class Learnt:
    """One constant.

    ``gain``: what it is worth on data it was not fitted to, in nats; ``kept``: whether the rig has ``fitted``, or still
    ``before``. ``error``: standard error of ``fitted``. ``per_log``: of each log alone, or of the halves of a single one.
    ``uncertainty``: how much it differs between logs, None where that is not known or the rig has no place for it.
    """

    sensor: str
    name: str
    before: float
    fitted: float
    error: float
    gain: float
    kept: bool
    why: str
    per_log: tuple[float, ...]
    uncertainty: float | None

    @property
    def value(self) -> float:
        return self.fitted if self.kept else self.before


@dataclass(frozen=True)
class Knowledge:
    """What the logs say. ``rig`` has the scatter as noise; ``noise`` is None where the reference has no heading.

    ``windows``: of 2 s, by log; ``seen``: by log, none without landmarks; ``rfid``: None without reads of tags; ``notes``: what
    could not be learnt, one line each.
    """

    rig: Rig
    constants: tuple[Learnt, ...]
    noise: NoiseFit | None
    windows: tuple[Windows, ...]
    seen: tuple[Sightings, ...]
    correlations: tuple[Correlation, ...]
    notes: tuple[str, ...]
    rfid: RfidKnowledge | None = None


def learn(logs: Sequence[Log], rig: Rig, grids: Path | None = None, rfid_kind: Kind | None = None) -> Knowledge:
    """The rig that ``logs`` tell, starting from ``rig``, whose values stay where a log cannot tell them better.

    ``grids`` and ``rfid_kind``: see :func:`~factorgraph_loc.calibration.rfid_learn.learn_rfid`; for logs with reads of tags.
    Raises InputError if a log is too short.
    """
    logs = [replace(log, rig=rig) for log in logs]
    notes = []
    learnt: list[Learnt] = []
    noise: NoiseFit | None = None
    windows: tuple[Windows, ...] = ()
    if has_heading(logs[0]):
        windows = tuple(cut(log, odometry.WINDOW) for log in logs)
        for one in windows:
            if len(one.begin) < MIN_WINDOWS:
                raise InputError(
                    f"{one.log.name}: odometry and reference overlap in {len(one.begin)} windows of {odometry.WINDOW:g} s, "
                    f"expected {MIN_WINDOWS} or more"
                )
        found, noise = _learn_odometry(windows, logs, rig)
        learnt += found
        rig = _with_odometry(rig, found, noise)
    else:
        notes.append(
            "The reference has no headings: of the constants only the range scale is learnt, the odometry stays."
        )
    seen: tuple[Sightings, ...] = ()
    correlations: tuple[Correlation, ...] = ()
    if "bearing_range" in logs[0].streams:
        seen = tuple(sightings_with(log) for log in logs)
        found, sensor = _learn_sensor(seen, rig)
        learnt += found
        if rig.bearing_range is not None and sensor.range_kind != rig.bearing_range.range_kind:
            notes.append(
                f"The ranges fit better as the {sensor.range_kind} than as the {rig.bearing_range.range_kind}."
            )
        rig = rig.model_copy(update={"bearing_range": sensor})
        correlations = tuple(sightings.correlation(one, sensor) for one in seen)
    rfid: RfidKnowledge | None = None
    if "rfid" in logs[0].streams:
        if grids is None:
            raise ValueError("logs with reads of tags need a place for grids")
        rig, rfid = learn_rfid(logs, rig, grids, rfid_kind)
    rig = sensing(_uncertainties(rig, learnt), logs[0])
    if len(logs) == 1:
        notes.append(
            "One log cannot tell what differs between runs: the uncertainties of constants are those of the input rig."
        )
    return Knowledge(rig, tuple(learnt), noise, windows, seen, correlations, tuple(notes), rfid)


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


def _learn_odometry(windows: Sequence[Windows], logs: Sequence[Log], rig: Rig) -> tuple[list[Learnt], NoiseFit]:
    constants = odometry.constants_of(windows[0], rig.odometry)
    model = rig.odometry_model()
    start = {c.name: c.neutral for c in constants}
    start |= {name: max(start[name], odometry.LAGGING_START) for name in ("delay", "lag") if name in start}
    for _ in range(ROUNDS):
        sigmas = odometry.scatter(windows, odometry.with_constants(model, start))
        everything = odometry.fit_odometry(windows, model, constants, sigmas, start)
        start = everything.as_dict()
    denied = odometry.denied_at_rest(everything, windows)
    gain = gains(everything, folds([one.begin for one in windows], BLOCKS), denied)
    kept = [c for c, g in zip(constants, gain, strict=True) if is_worth(g)]
    pooled = odometry.fit_odometry(windows, model, kept, sigmas, start) if kept else None
    model = odometry.with_constants(model, pooled.as_dict() if pooled else {})
    apart = _apart("odometry", constants, start, kept)
    parts = windows if len(windows) > 1 else windows[0].halves()
    alone = [
        {n: v for some in apart for n, v in odometry.fit_odometry([one], model, some, sigmas, start).as_dict().items()}
        for one in parts
    ]
    learnt = _describe("odometry", everything, pooled, alone, gain, len(logs), denied)
    return learnt, fit_noise(logs, model)


def _learn_sensor(seen: Sequence[Sightings], rig: Rig) -> tuple[list[Learnt], BearingRangeSettings]:
    before = rig.bearing_range or BearingRangeSettings(range_sigma=_FIRST_SIGMA)
    seen = [one.thinned(MOST_SIGHTINGS) for one in seen]
    everything, settings = _fit_and_scatter(seen, before)
    if sightings.could_be_depths(seen):
        other = before.model_copy(update={"range_kind": "distance" if before.range_kind == "depth" else "depth"})
        found, changed = _fit_and_scatter(seen, other)
        if sightings.range_spread(seen, changed) < BETTER_KIND * sightings.range_spread(seen, settings):
            everything, settings = found, changed
    constants, start = everything.constants, everything.as_dict()
    gain = gains(everything, folds([one.t for one in seen], BLOCKS))
    kept = [c for c, g in zip(constants, gain, strict=True) if is_worth(g)]
    settings = settings.model_copy(update={c.name: c.neutral for c in constants})
    pooled = sightings.fit_sensor(seen, settings, kept, start) if kept else None
    settings = settings.model_copy(update=pooled.as_dict() if pooled else {})
    apart = _apart("bearing_range", constants, start, kept)
    parts = seen if len(seen) > 1 else seen[0].halves()
    alone = [
        {n: v for some in apart for n, v in sightings.fit_sensor([one], settings, some, start).as_dict().items()}
        for one in parts
    ]
    learnt = _describe("bearing_range", everything, pooled, alone, gain, len(seen))
    return learnt, sightings.with_scatter(seen, settings)


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


def _describe(
    sensor: str,
    everything: Fit,
    pooled: Fit | None,
    alone: Sequence[Mapping[str, float]],
    gain: Array,
    logs: int,
    denied: Collection[str] = (),
) -> list[Learnt]:
    """The table of one sensor's constants. ``alone``: fits of each log, or of the halves of a single one."""
    values, errors = everything.as_dict(), everything.errors_as_dict()
    kept = [] if pooled is None else [c.name for c in pooled.constants]
    if pooled is not None:
        values |= pooled.as_dict()
        errors |= pooled.errors_as_dict()
    out = []
    for c, gained in zip(everything.constants, gain, strict=True):
        parts = np.array([found[c.name] for found in alone if c.name in found])
        value = values[c.name] if c.name in kept else c.neutral
        spread = 0.0
        if len(parts) > 1:  # about the mean that was fitted to them, or about a value that was not
            spread = float(np.sqrt(np.sum((parts - value) ** 2) / (len(parts) - (c.name in kept))))
        error = max(errors[c.name], spread / np.sqrt(len(parts)) if len(parts) and c.name in kept else 0.0)
        uncertainty = None
        if c.name in UNCERTAIN[sensor] and logs > 1:
            uncertainty = max(spread, error) / (abs(value) if "scale" in c.name else 1.0)
        out.append(
            Learnt(
                sensor,
                c.name,
                before=c.neutral,
                fitted=values[c.name],
                error=error,
                gain=float(np.sum(gained)),
                kept=c.name in kept,
                why="not kept: windows in which the robot stood deny it"
                if c.name in denied
                else _why(c, values[c.name], gained),
                per_log=tuple(parts.tolist()),
                uncertainty=uncertainty,
            )
        )
    return out


def _why(constant: Constant, value: float, gain: Array) -> str:
    if not constant.is_inside(value):
        return f"not kept: the fit stopped at its bound {value:.3g}"
    if is_worth(gain):
        return "kept: it predicts data it was not fitted to better"
    return "not kept: without it, data it was not fitted to are predicted as well or better"


def _with_odometry(rig: Rig, learnt: Sequence[Learnt], noise: NoiseFit) -> Rig:
    growth = {
        error: GrowthSettings(per_distance=g.per_distance, per_rotation=g.per_rotation, per_time=g.per_time)
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

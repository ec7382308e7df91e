"""Which estimators are run on which log, from which start and with which settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

import absurd_logs
import short_logs

from factorgraph_loc.experiments.run import RunConfig
from factorgraph_loc.model.log import Log
from factorgraph_loc.planning.closed_loop import run_active
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.simulation import preset
from regression import logs
from regression.records import Record, record_active, record_log, record_run

# label of a run: estimator and settings
RUNS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "dead_reckoning": ("dead_reckoning", {}),
    "ekf": ("ekf", {}),
    "ekf_iterated": ("ekf", {"iterations": 3}),
    "particle_filter": ("particle_filter", {"particles": 300}),
    "particle_filter_kld": ("particle_filter", {"particles": 600, "kld": True, "min_particles": 100}),
    "particle_filter_many": ("particle_filter", {}),
    "smoother": ("smoother", {}),
    "smoother_lag": ("smoother", {"lag": 3.0}),
    "batch": ("batch", {}),
    "switching": ("switching", {"particles": 300}),
    "monoslam": ("monoslam", {}),
}
LAG = "smoother_lag"
GRAPHS = ("smoother", LAG, "batch")
FINDERS = ("ekf", "particle_filter", "smoother", "batch")
MAPPERS = ("ekf", *GRAPHS)
ON_FLOOR = ("dead_reckoning", *FINDERS, "switching")
READERS = ("particle_filter", "smoother", "batch", "switching")
WATCHERS = (*FINDERS, "monoslam")

LANDMARKS = ("odometry", "bearing_range")
TAGS = ("odometry", "rfid")
LOG = "log"  # label of the log itself
POSITION = "position"  # a prior: the true position and any heading
UNKNOWN = {"landmarks": "unknown"}


@dataclass(frozen=True)
class Scenario:
    """A log, made when it is needed, and the ``labels`` of what is run on it; ``settings`` go over those of :data:`RUNS`.

    ``data``: the name of the recorded log that it is from, if any; ``mounted``: whether the rig says that mounting and clock of
    the RFID reader are known exactly.
    """

    log: Callable[[], Log]
    labels: tuple[str, ...]
    sensors: tuple[str, ...] | None = None
    prior: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    data: str | None = None
    mounted: bool = True

    def cases(self) -> tuple[str, ...]:
        return (LOG, *self.labels)

    def record(self, label: str) -> Record:
        """Run one case."""
        log = short_logs.mounted_exactly(_made(self.log)) if self.mounted else _made(self.log)
        if label == LOG:
            return record_log(log)
        estimator, settings = RUNS[label]
        prior = self.prior
        if prior == POSITION:
            x, y, _ = log.reference.poses[0]
            prior = f"{x},{y}"
        return record_run(log, RunConfig(estimator, {**settings, **self.settings}, self.sensors, prior))


@dataclass(frozen=True)
class ActiveScenario:
    """A robot that seeks its place in a simulated world."""

    preset: str
    policy: str
    labels: tuple[str, ...]
    changes: Mapping[str, Any] = field(default_factory=dict)
    data: None = None

    def cases(self) -> tuple[str, ...]:
        return self.labels

    def record(self, label: str) -> Record:
        """Run one case."""
        # limits that are not reached: it drives on until the time is up
        settings = ActiveSettings(particles=500, max_seconds=10.0, position_limit=0.01, heading_limit=0.005)
        return record_active(run_active(preset(self.preset, self.changes), self.policy, label, 1, settings))


_made = cache(lambda make: make())


def _faulty(name: str) -> Scenario:
    return Scenario(partial(logs.fault, name), FINDERS)


def _tags(**faults: Any) -> Callable[[], Log]:
    return partial(logs.tags, faults)


def recorded(name: str, start: float, seconds: float, labels: tuple[str, ...], **more: Any) -> Scenario:
    """Estimators on a part of a recorded log."""
    return Scenario(partial(logs.recorded, name, start, seconds), labels, data=name, **more)


SCENARIOS: Mapping[str, Scenario | ActiveScenario] = {
    "landmarks": Scenario(logs.landmarks, (*ON_FLOOR, LAG, "ekf_iterated", "particle_filter_kld", "monoslam")),
    "landmarks-increments": Scenario(short_logs.office, ON_FLOOR, LANDMARKS),
    "landmarks-gyro": Scenario(
        lambda: short_logs.with_gyro(short_logs.office()), (*ON_FLOOR, "monoslam"), ("odometry", "imu", "bearing_range")
    ),
    "landmarks-late": Scenario(
        lambda: short_logs.late(logs.landmarks(), "bearing_range"), (*FINDERS, LAG, "switching")
    ),
    "landmarks-unknown-start": Scenario(logs.landmarks, (*FINDERS, LAG), prior="unknown"),
    "landmarks-unknown-heading": Scenario(logs.landmarks, (*FINDERS, "switching"), prior=POSITION),
    "landmarks-wrong-start": Scenario(logs.landmarks, FINDERS, prior="3,3,1.0"),
    "landmarks-kidnapped": Scenario(logs.landmarks_kidnapped, (*FINDERS, LAG)),
    "landmarks-wrong-rows": Scenario(logs.landmarks_with_wrong_rows, (*FINDERS, "switching")),
    "landmarks-gap": Scenario(logs.landmarks_with_gap, ON_FLOOR),
    "landmarks-bearings": Scenario(partial(logs.landmarks_without, "range"), FINDERS),
    "landmarks-ranges": Scenario(partial(logs.landmarks_without, "bearing"), FINDERS, prior=POSITION),
    "landmarks-slam": Scenario(logs.landmarks, MAPPERS, settings=UNKNOWN),
    "landmarks-slam-late": Scenario(
        lambda: short_logs.late(logs.landmarks(), "bearing_range"), ("ekf", "smoother"), settings=UNKNOWN
    ),
    "landmarks-extended-map": Scenario(
        partial(logs.landmarks_without_map_of, "bh"), MAPPERS, settings={"landmarks": "extended"}
    ),
    "landmarks-self-calibration": Scenario(partial(logs.landmarks_miscalibrated, depth=False), (*FINDERS, LAG)),
    "landmarks-constants-as-noise": Scenario(
        partial(logs.landmarks_miscalibrated, depth=False), FINDERS, settings={"self_calibration": False}
    ),
    "landmarks-depths": Scenario(partial(logs.landmarks_miscalibrated, depth=True), FINDERS),
    "plaza-ranges": Scenario(short_logs.plaza, (*ON_FLOOR, LAG)),
    "tags": Scenario(short_logs.office, (*READERS, LAG, "particle_filter_kld", "ekf"), TAGS),
    "tags-turned": Scenario(
        logs.tags_of_turned_antennas, ("ekf", "particle_filter", "smoother", "batch"), mounted=False
    ),
    "tags-strength": Scenario(short_logs.office, READERS, (*TAGS, "rssi")),
    "tags-phase": Scenario(short_logs.office, (*READERS, LAG), (*TAGS, "phase")),
    "tags-landmarks": Scenario(
        short_logs.office, ("ekf", *READERS), ("odometry", "rfid", "rssi", "phase", "bearing_range")
    ),
    "tags-late": Scenario(logs.tags_read_late, (*READERS, LAG), TAGS),
    "tags-unknown-start": Scenario(_tags(), READERS, prior="unknown"),
    "tags-unknown-heading": Scenario(_tags(), READERS, prior=POSITION),
    "tags-landmarks-unknown-start": Scenario(absurd_logs.whole, READERS, prior="unknown"),
    "tags-landmarks-undecided": Scenario(
        short_logs.office, ("particle_filter", "smoother"), ("odometry", "rfid", "bearing_range"), prior="unknown"
    ),
    "tags-kidnapped": Scenario(logs.tags_kidnapped, READERS),
    "tags-dead": Scenario(_tags(dead=0.4), READERS),
    "tags-silent-reader": Scenario(_tags(silence={"time": 4.0, "duration": 5.0}), READERS),
    "tags-antenna-stops": Scenario(_tags(antenna_stop={"antenna": "1", "time": 3.0, "rounds_go_on": True}), READERS),
    "tags-false-reads": Scenario(_tags(false_reads=0.05, misplaced=0.2), READERS),
    "points": Scenario(logs.room, (*ON_FLOOR, LAG, "monoslam")),
    "points-late": Scenario(lambda: short_logs.late(logs.room(), "sightings"), (*WATCHERS, LAG)),
    "points-unknown-start": Scenario(logs.room, WATCHERS, prior="unknown"),
    "points-unknown-heading": Scenario(logs.room, WATCHERS, prior=POSITION),
    "points-wrong-start": Scenario(logs.room, WATCHERS, prior="-1,1,2"),
    "points-kidnapped": Scenario(logs.points_kidnapped, (*WATCHERS, LAG)),
    "points-wrong-names": Scenario(logs.points_with_wrong_names, WATCHERS),
    "points-gap": Scenario(logs.points_with_gap, WATCHERS),
    "points-uncertain-map": Scenario(logs.points_of_uncertain_map, WATCHERS),
    "points-self-calibration": Scenario(logs.points_by_unknown_camera, (*WATCHERS, LAG)),
    "points-slam": Scenario(logs.room, (*GRAPHS, "monoslam"), settings=UNKNOWN),
    "points-extended-map": Scenario(
        logs.points_half_known, ("smoother", "batch", "monoslam"), settings={"landmarks": "extended"}
    ),
    "markers": Scenario(logs.markers, WATCHERS),
    "features": Scenario(logs.frames, (*WATCHERS, "switching")),
    "features-unknown-start": Scenario(logs.frames, WATCHERS, prior="unknown"),
    "features-slam": Scenario(logs.followed_frames, ("smoother", "batch", "monoslam"), settings=UNKNOWN),
    **{
        f"fault-{name.replace('_', '-')}": _faulty(name)
        for name in (
            "many_glitches",
            "repeated_rows",
            "missing_rows",
            "clock_jumps_back",
            "wrong_map",
            "random_sightings",
            "no_odometry",
            "all_tags_read_everywhere",
        )
    },
    "recorded-mrclam": recorded("mrclam6-robot3", 40.0, 8.0, ON_FLOOR),
    "recorded-mrclam-unknown-start": recorded("mrclam6-robot3", 40.0, 8.0, FINDERS, prior="unknown"),
    "recorded-mrclam-slam": recorded("mrclam6-robot3", 40.0, 8.0, MAPPERS, settings=UNKNOWN),
    "recorded-woods": recorded("woods-r5", 70.0, 8.0, ON_FLOOR),
    "recorded-tags": Scenario(
        logs.aisle, (*GRAPHS, "particle_filter"), (*TAGS, "rssi", "phase"), data="rfid-aisle-run13"
    ),
    "active-tags": ActiveScenario("office", "information", ("active_mcl", "smoother")),
    "active-landmarks": ActiveScenario(
        "office", "nearest_tags", ("active_mcl", "smoother"), {"world": {"tags": 10, "landmarks": 20}}
    ),
}

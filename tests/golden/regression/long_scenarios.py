"""Longer logs, whose results are not stored: two commits are held against each other by them."""

from __future__ import annotations

from collections.abc import Mapping

import camera_world
from short_logs import with_signals

from factorgraph_loc.model.log import Log, cut, join
from factorgraph_loc.simulation import preset, simulate
from regression.scenarios import FINDERS, LAG, MAPPERS, ON_FLOOR, READERS, UNKNOWN, WATCHERS, Scenario, recorded

START, SECONDS = 60.0, 60.0  # of the parts; before that the robot in the woods stands
MANY = "particle_filter_many"
BEACONS = ("plaza1", "plaza2", "mrclam6-robot1", "mrclam6-robot3", "mrclam6-robot5", "woods-r1", "woods-r3", "woods-r5")
SHELVES = ("rfid-aisle-run13", "rfid-aisle-run16")


def office() -> Log:
    """Tags, strength, phase and landmarks, and a third of the tags dead."""
    world = {"tags": 30, "landmarks": 20}
    changes = {"drive": {"duration": 60.0}, "phase": {}, "rssi": {}, "world": world, "faults": {"dead": 0.3}}
    return with_signals(simulate(preset("office", changes), 1))


def office_kidnapped() -> Log:
    log = simulate(preset("office", {"drive": {"duration": 120.0}, "world": {"tags": 40}}), 4)
    return join(cut(log, 0.0, 30.0), cut(log, 80.0, 120.0))


def room() -> Log:
    return camera_world.simulate(seconds=40.0, speeds=camera_world.weave)


LONG_SCENARIOS: Mapping[str, Scenario] = {
    **{f"long-{name}": recorded(name, START, SECONDS, (*ON_FLOOR, LAG, MANY)) for name in BEACONS},
    **{
        f"long-{name}-unknown-start": recorded(name, START, SECONDS, (*FINDERS, LAG), prior="unknown")
        for name in ("mrclam6-robot1", "woods-r5")
    },
    **{
        f"long-{name}-slam": recorded(name, START, SECONDS, MAPPERS, settings=UNKNOWN)
        for name in ("mrclam6-robot1", "woods-r5")
    },
    **{f"long-{name}": recorded(name, START, SECONDS, (*READERS, LAG, "ekf")) for name in SHELVES},
    "long-rfid-aisle-run13-unknown-start": recorded(
        "rfid-aisle-run13", START, 20.0, ("particle_filter", "smoother"), prior="unknown"
    ),
    "long-office": Scenario(office, (*READERS, LAG, MANY), ("odometry", "rfid", "rssi", "phase", "bearing_range")),
    "long-office-kidnapped": Scenario(office_kidnapped, READERS),
    "long-room": Scenario(room, (*WATCHERS, LAG, MANY)),
    "long-room-slam": Scenario(room, ("smoother", LAG, "batch", "monoslam"), settings=UNKNOWN),
}

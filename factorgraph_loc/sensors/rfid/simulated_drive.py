"""Simulated RFID reads on a drive, and the surveyed map of tags."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from factorgraph_loc.sensors.interfaces import Ride, Simulated
from factorgraph_loc.sensors.rfid.map import Tag
from factorgraph_loc.sensors.rfid.settings import RfidSettings, SurveySettings
from factorgraph_loc.sensors.rfid.simulated_signals import phases, strengths
from factorgraph_loc.sensors.rfid.simulation import draw_dead, draw_reads, read_probabilities, rfid_stream
from factorgraph_loc.sensors.rfid.simulation_settings import FaultSettings
from factorgraph_loc.sensors.rfid.tag_map import tag_map
from factorgraph_loc.text import listed, quoted
from factors.se2 import Array

SPARSE = 20  # every n-th pose is used to check the donors
MOST_UNMATCHED = 0.1  # maximum share of rounds in range without a similar recorded one


def simulate(ride: Ride) -> Simulated:
    """The reads of a simulated drive, with all faults."""
    settings, rfid, recorded, rng = ride.settings, ride.rig.of(RfidSettings), ride.recorded, ride.rng("reads")
    tags = tag_map(ride.world, ride.rig.of(SurveySettings))
    times = ride.times(settings.rounds_per_second)
    poses = ride.truth.at(times)
    # recorded outcomes are probabilities of zero and one
    p = read_probabilities(rfid, tags.tags, poses) if recorded is None else recorded.outcomes(tags.tags, poses, rng)
    names, epcs = list(rfid.all_antennas()), list(tags.names)
    dead = draw_dead(settings.faults, len(epcs), rng)
    hits = draw_reads(rfid, p, times, settings.faults, dead, rng)
    signals: dict[str, Array] = {}
    if settings.rssi is not None:
        signals["rssi"] = strengths(rfid, tags.tags, poses, hits, settings.rssi, ride.rng("strengths"))
    if settings.phase is not None:
        signals["phase"] = phases(rfid, tags.tags, poses, settings.phase, ride.rng("phases"))
        signals["frequency"] = np.full(hits.shape, settings.phase.frequency)
    stream = rfid_stream(names, epcs, times, hits, settings.faults, signals)
    surveyed, misplaced = _surveyed(ride.world.tags, settings.faults, ride.rng_of_world("survey"))
    metadata, warnings = {}, []
    if recorded is not None:
        metadata["reads"] = "resampled from recorded rounds at similar range, bearing, height and facing"
        share = recorded.unmatched(tags.tags, ride.truth.poses[::SPARSE])
        if share > MOST_UNMATCHED:
            warnings.append(f"rfid: {share:.0%} of the rounds in range have no similar recorded one")
    if len(dead):
        metadata["dead"] = ", ".join(epcs[i] for i in sorted(dead.tolist()))
    if misplaced:
        metadata["misplaced"] = ", ".join(misplaced)
    return Simulated({"rfid": stream}, {"tags": surveyed}, metadata, tuple(warnings))


def looks(settings: Any) -> dict[str, float]:
    """Rate [Hz] of the simulated rounds; ValueError if rig and faults are inconsistent."""
    if settings.rig.find(RfidSettings) is None:
        raise ValueError("the rig has no rfid, expected antennas")
    stop, names = settings.faults.antenna_stop, list(settings.rig.of(RfidSettings).all_antennas())
    if stop is not None and stop.antenna not in names:
        raise ValueError(f"antenna {quoted(stop.antenna)} stops, expected one of {listed(names)}")
    return {"tags": settings.rounds_per_second * len(names) * settings.world.tag_count()}


def _surveyed(
    tags: Mapping[str, Tag], faults: FaultSettings, rng: np.random.Generator
) -> tuple[dict[str, Tag], list[str]]:
    """The tags of the surveyed map, and the names of misplaced ones."""
    names = list(tags)
    chosen = sorted(rng.permutation(len(names))[: round(faults.misplaced * len(names))].tolist())
    surveyed = dict(tags)
    for i in chosen:
        tag, direction = surveyed[names[i]], rng.uniform(-math.pi, math.pi)
        x, y = tag.x + faults.misplaced_by * math.cos(direction), tag.y + faults.misplaced_by * math.sin(direction)
        surveyed[names[i]] = tag.model_copy(update={"x": x, "y": y})
    return surveyed, [names[i] for i in chosen]

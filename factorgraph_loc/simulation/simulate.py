"""A simulated log: world, drive, and what the sensors report, all of one seed."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from factorgraph_loc.model.log import Log, StartPose
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.stream import Stream
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.simulation import pixel_stream
from factorgraph_loc.sensors.landmarks.simulation import sighting_stream
from factorgraph_loc.sensors.odometry.simulation import wheel_odometry
from factorgraph_loc.sensors.rfid.recorded import RecordedLooks
from factorgraph_loc.sensors.rfid.settings import SurveySettings
from factorgraph_loc.sensors.rfid.simulated_signals import phases, strengths
from factorgraph_loc.sensors.rfid.simulation import draw_dead, draw_reads, read_probabilities, rfid_stream
from factorgraph_loc.sensors.rfid.simulation_settings import FaultSettings
from factorgraph_loc.sensors.rfid.tag_map import tag_map
from factorgraph_loc.simulation.settings import SimulationSettings
from factorgraph_loc.simulation.trajectories import drive
from factorgraph_loc.simulation.worlds import make_world
from factorgraph_loc.version import __version__
from factors import se2
from factors.se2 import Array

SPARSE = 20  # poses, of which one is enough to tell how well recorded looks match
START_SIGMAS = np.array((0.1, 0.1, 0.05))  # m, m, rad


def simulate(settings: SimulationSettings, seed: int, recorded: RecordedLooks | None = None) -> Log:
    """The log of ``settings`` and ``seed``; the same both, the same log, to the last bit.

    Streams: odometry, rfid, bearing_range where the world has landmarks, and sightings where it has points. The reference is
    the true trajectory. The stated start is the true pose with an error drawn from the deviations that it states
    (:data:`START_SIGMAS`), as consistency needs it. World, drive and each sensor draw from generators of their own, so that to
    change one leaves the others as they are.
    With ``recorded`` the robot carries the antennas of those recordings, and reads what they read (:mod:`.recorded`).
    InputError if the settings leave no room for tags or for the robot.
    """
    rngs = generators(seed)
    of_world = rngs if settings.world_seed is None else generators(settings.world_seed)
    rig = settings.rig
    if recorded is not None:
        rig = rig.model_copy(update={"rfid": recorded.rfid, "survey": SurveySettings()})
    world = make_world(settings.world, of_world[0])
    truth = drive(world, settings.drive, rngs[1])
    streams: dict[str, Stream] = {
        "odometry": wheel_odometry(truth, int(rngs[2].integers(2**32))),
    }
    streams["rfid"], dead = _reads(settings, rig, world, truth, recorded, (rngs[3], rngs[7], rngs[8]))
    if world.landmarks and rig.bearing_range is not None:
        times = ticks(settings.sightings.rate, truth)
        model = rig.bearing_range.model()
        streams["bearing_range"] = sighting_stream(model, world, times, truth.at(times), settings.sightings, rngs[4])
    if world.points is not None and rig.camera is not None:
        times = ticks(settings.pixels.rate, truth)
        seen = pixel_stream(rig.camera.model(), world, times, truth.at(times), settings.pixels, rngs[9])
        streams["sightings"] = replace(seen, t=seen.t - rig.camera.time_offset)
    surveyed, misplaced = _surveyed(world, settings.faults, of_world[5])
    start = truth.poses[0] + START_SIGMAS * rngs[6].standard_normal(3)
    start[2] = se2.wrap_scalar(start[2])
    metadata = {"origin": f"simulated by fgloc {__version__}", "preset": settings.name, "seed": str(seed)}
    if settings.world_seed is not None:
        metadata["world_seed"] = str(settings.world_seed)
    warnings = []
    if recorded is not None:
        metadata["reads"] = "outcomes of recorded rounds at like range, bearing, height and facing"
        share = recorded.unmatched(tag_map(world, rig.survey).tags, truth.poses[::SPARSE])
        if share > 0.1:
            warnings.append(f"rfid: {share:.0%} of the looks in reach have no recorded one that is alike")
    if dead:
        metadata["dead"] = ", ".join(dead)
    if misplaced:
        metadata["misplaced"] = ", ".join(misplaced)
    return Log(
        name=f"{settings.name}-{seed}",
        rig=with_sensors(rig, streams),
        world=surveyed,
        streams=streams,
        reference=truth,
        start=StartPose(0.0, start, START_SIGMAS.copy()),
        warnings=tuple(warnings),
        metadata=metadata,
    )


def generators(seed: int) -> list[np.random.Generator]:
    """Those of: world, drive, odometry, reads, landmarks, survey, start, strengths, phases, points, look of the world, camera. More
    of them may follow: the first ones stay what they are."""
    return np.random.default_rng(seed).spawn(12)


def _reads(
    settings: SimulationSettings,
    rig: Rig,
    world: World,
    truth: Trajectory,
    recorded: RecordedLooks | None,
    rngs: tuple[np.random.Generator, ...],
) -> tuple[Stream, list[str]]:
    """What the antennas read, and the tags that are dead."""
    rfid = rig.rfid
    assert rfid is not None, "the settings have been checked"
    tags = tag_map(world, rig.survey)
    times = ticks(settings.rounds_per_second, truth)
    poses = truth.at(times)
    # recorded outcomes are probabilities of zero and one
    p = read_probabilities(rfid, tags.tags, poses) if recorded is None else recorded.outcomes(tags.tags, poses, rngs[0])
    names, epcs = list(rfid.all_antennas()), list(tags.names)
    dead = draw_dead(settings.faults, len(epcs), rngs[0])
    hits = draw_reads(rfid, p, times, settings.faults, dead, rngs[0])
    signals: dict[str, Array] = {}
    if settings.rssi is not None:
        signals["rssi"] = strengths(rfid, tags.tags, poses, hits, settings.rssi, rngs[1])
    if settings.phase is not None:
        signals["phase"] = phases(rfid, tags.tags, poses, settings.phase, rngs[2])
        signals["frequency"] = np.full(hits.shape, settings.phase.frequency)
    stream = rfid_stream(names, epcs, times, hits, settings.faults, signals)
    return stream, [epcs[i] for i in sorted(dead.tolist())]


def ticks(rate: float, truth: Trajectory) -> Array:
    """Times (N,) of a sensor, the first after one period."""
    count = int(float(truth.t[-1]) * rate + 1e-9)
    return np.asarray(np.minimum(np.arange(1, count + 1) / rate, truth.t[-1]))


def _surveyed(world: World, faults: FaultSettings, rng: np.random.Generator) -> tuple[World, list[str]]:
    """The map that estimators are given, and the tags that are misplaced in it."""
    names = list(world.tags)
    chosen = rng.permutation(len(names))[: round(faults.misplaced * len(names))]
    tags = dict(world.tags)
    for i in sorted(chosen.tolist()):
        tag, direction = tags[names[i]], rng.uniform(-math.pi, math.pi)
        x, y = tag.x + faults.misplaced_by * math.cos(direction), tag.y + faults.misplaced_by * math.sin(direction)
        tags[names[i]] = tag.model_copy(update={"x": x, "y": y})
    return world.model_copy(update={"tags": tags}), [names[i] for i in sorted(chosen.tolist())]


def with_sensors(rig: Rig, streams: Mapping[str, Stream]) -> Rig:
    """The rig, whose estimators use by default what the log has."""
    sensors = (*rig.sensors, *(name for name in streams if name not in rig.sensors))
    return rig.model_copy(update={"sensors": sensors})

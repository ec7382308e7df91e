"""Logs with faults that rig and map do not contain. Each is returned together with the log without the fault.

wall: the robot is stopped by a wall, and its wheels turn for 10 s; it measures ranges to four radio anchors.
blocked: the ranges to one of these anchors are 1.2 m too long for 40 s.
plaza: the wheels report 1 m/s too much for 10 s, in the recording Plaza2.
slip: the wheels slip by 0.5 m, twice; the robot reads tags.
carried: the robot is carried for 20 s with resting wheels, and reads tags on the way.
moved: a quarter of the tags is 1 m away from its position in the map.
turned: all antennas are turned by 10 degrees. late: the stamps of reads are 0.15 s too late.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import factorgraph_loc as fgloc
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings, BearingRangeStream, Landmark
from factorgraph_loc.sensors.odometry.measurement import VelocityStream
from factors import se2

ANCHORS = {"a": (0.0, 0.0), "b": (12.0, 0.0), "c": (12.0, 8.0), "d": (0.0, 8.0)}
STEP, SPEED, TURN, SIGMA = 0.05, 0.5, 0.2, 0.1  # s, m/s, rad/s, m
TURNED, LATE = np.radians(10.0), 0.15  # rad, s
DATASETS = Path(__file__).resolve().parents[3] / "datasets"

Case = tuple[Log, Log]  # with the fault, and without it


def radios(seed: int, *, slips: float = 0.0, blocked: float = 0.0) -> Log:
    """Simulate a drive of 120 s in a circle among radio anchors. ``slips``, ``blocked`` [s]: from 40 s on, the wheels slip for this
    time, and the radio of anchor c is blocked for this time."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 120.0, STEP)
    stands = (t >= 40.0) & (t < 40.0 + slips)
    poses = [np.array((4.0, 2.0, 0.3))]
    for rest in stands[:-1]:
        poses.append(poses[-1] if rest else se2.compose(poses[-1], se2.exp(np.array((SPEED, 0.0, TURN)) * STEP)))
    at, seen = np.array(poses), np.arange(0, len(t), 2)
    names = [list(ANCHORS)[i % len(ANCHORS)] for i in range(len(seen))]
    ranges = np.hypot(*(at[seen, :2] - [ANCHORS[name] for name in names]).T) + rng.normal(0.0, SIGMA, len(seen))
    ranges += 1.2 * (np.array(names) == "c") * (t[seen] >= 40.0) * (t[seen] < 40.0 + blocked)
    wheels = SPEED + rng.normal(0.0, 0.01, len(t)), TURN + rng.normal(0.0, 0.01, len(t))
    streams = {
        "odometry": VelocityStream(t, *wheels),
        "bearing_range": BearingRangeStream(t[seen], names, ranges, np.full(len(seen), np.nan)),
    }
    world = World(landmarks={name: Landmark(x=x, y=y) for name, (x, y) in ANCHORS.items()})
    return Log("radios", Rig(bearing_range=BearingRangeSettings(range_sigma=SIGMA)), world, streams, Trajectory(t, at))


def wheels_changed(log: Log, begin: float, end: float, share: float, more: float) -> Log:
    """Return the log with changed odometry between the times ``begin`` and ``end`` [s]. The reported motion is multiplied by
    ``share``, and ``more`` [m/s] is added to its speed."""
    odometry = log.streams["odometry"]
    within = (odometry.t > begin) & (odometry.t <= end)
    kept, dt = np.where(within, share, 1.0), np.diff(odometry.t, prepend=odometry.t[0])
    dx = kept * odometry.dx + more * dt * within
    changed = replace(odometry, dx=dx, dy=kept * odometry.dy, dtheta=kept * odometry.dtheta)
    return replace(log, streams={**log.streams, "odometry": changed})


def office(seed: int, seconds: float, **faults: float) -> Log:
    """Simulate a drive through an office with 40 tags. ``faults``: settings of simulated faults."""
    return fgloc.simulate("office", seed, changes={"drive": {"duration": seconds}, "faults": faults})


def plaza(seed: int) -> Case:
    log = fgloc.read_log(DATASETS / "plaza2.toml")
    begin = 100.0 * (1 + (seed - 1) % 3)
    return wheels_changed(log, begin, begin + 10.0, 1.0, 1.0), log


def slip(seed: int) -> Case:
    log = office(seed, 600.0)
    return wheels_changed(wheels_changed(log, 200.0, 201.0, 1.0, 0.5), 400.0, 401.0, 1.0, 0.5), log


def carried(seed: int) -> Case:
    log = office(seed, 140.0)
    return wheels_changed(log, 60.0, 80.0, 0.0, 0.0), log


def moved(seed: int) -> Case:
    log, right = office(seed, 120.0, misplaced=0.25), office(seed, 120.0)
    return log, replace(log, world=right.world)


def turned(seed: int) -> Case:
    log = office(seed, 600.0)
    settings = log.rig.rfid
    antennas = {n: a.model_copy(update={"yaw": a.yaw + TURNED}) for n, a in settings.all_antennas().items()}
    rfid = settings.model_copy(update={"antennas": antennas, "preset": None})
    return replace(log, rig=log.rig.model_copy(update={"rfid": rfid})), log


def late(seed: int) -> Case:
    log = office(seed, 600.0)
    reads = log.streams["rfid"]
    return replace(log, streams={**log.streams, "rfid": replace(reads, t=reads.t + LATE)}), log


# by name of the case, a function that returns for a seed the log with the fault and the log without it
CASES: dict[str, Callable[[int], Case]] = {
    "wall": lambda seed: (radios(seed, slips=10.0), radios(seed)),
    "blocked": lambda seed: (radios(seed, blocked=40.0), radios(seed)),
    "plaza": plaza,
    "slip": slip,
    "carried": carried,
    "moved": moved,
    "turned": turned,
    "late": late,
}

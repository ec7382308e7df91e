"""The logs of the scenarios: short ones of every sensor, and what goes wrong with them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import absurd_logs
import camera_world
import landmark_world
import numpy as np
import short_logs
from camera_world import with_camera, with_frames, with_sightings
from changed_logs import rows, with_stream
from recorded_logs import recorded_log

from factorgraph_loc import Log, PointMap, World
from factorgraph_loc.maps.markers import Marker, corner_points
from factorgraph_loc.model.log import cut, join
from factorgraph_loc.sensors.camera.settings import CameraUncertainty
from factorgraph_loc.simulation import preset, simulate

SECONDS = 12.0  # of a drive among landmarks


@cache
def landmarks() -> Log:
    return landmark_world.simulate(seconds=SECONDS)


@cache
def room() -> Log:
    return camera_world.simulate(seconds=6.0, speeds=camera_world.weave)


@cache
def frames() -> Log:
    return with_frames(room(), clutter=30)


def followed_frames() -> Log:
    """The same, whose features are followed from image to image as long as they show one point."""
    followed = camera_world.with_tracks(room(), np.inf, seed=2, every=0.2, clutter=30)
    return replace(frames(), streams=followed.streams)


def _silent(log: Log, sensor: str, start: float, end: float) -> Log:
    t = log.streams[sensor].t
    return rows(log, sensor, np.flatnonzero((t < start) | (t >= end)))


def landmarks_with_gap() -> Log:
    """No landmarks in 4 to 8 s, and no odometry in 5 to 7.5 s."""
    return _silent(_silent(landmarks(), "bearing_range", 4.0, 8.0), "odometry", 5.0, 7.5)


def landmarks_with_wrong_rows() -> Log:
    """A fifth of the rows says anything, some of a landmark that the map lacks."""
    log, rng = landmarks(), np.random.default_rng(5)
    seen = log.streams["bearing_range"]
    count = len(seen.t)
    bad = rng.random(count) < 0.2
    names = np.where(rng.random(count) < 0.05, "nowhere", seen.landmark).tolist()
    ranges = np.where(bad, rng.uniform(0.3, 8.0, count), seen.range)
    bearings = np.where(bad, rng.uniform(-np.pi, np.pi, count), seen.bearing)
    return with_stream(log, "bearing_range", landmark=names, range=ranges, bearing=bearings)


def landmarks_without(column: str) -> Log:
    """Bearings alone, or ranges alone."""
    log = landmarks()
    return with_stream(log, "bearing_range", **{column: np.full(len(log.streams["bearing_range"].t), np.nan)})


def landmarks_without_map_of(names: str) -> Log:
    log = landmarks()
    left = {name: mark for name, mark in log.world.landmarks.items() if name not in names}
    return replace(log, world=log.world.model_copy(update={"landmarks": left}))


def landmarks_kidnapped() -> Log:
    elsewhere = cut(landmark_world.simulate(seed=3, seconds=33.0), 25.0, 33.0)
    return join(cut(landmarks(), 0.0, 6.0), elsewhere)


def landmarks_miscalibrated(*, depth: bool) -> Log:
    truth = landmark_world.DEPTH if depth else landmark_world.TRUTH
    return landmark_world.miscalibrated(landmark_world.simulate(seconds=20.0), truth, depth=depth)


def tags(faults: Mapping[str, Any]) -> Log:
    """Tags alone, fewer of them than would tell the place at once."""
    return simulate(preset("office", {"drive": {"duration": 14.0}, "world": {"tags": 20}, "faults": faults}), 2)


def tags_of_turned_antennas() -> Log:
    """The rig says that all antennas are turned by 0.15 rad, and that stamps are 0.1 s earlier, than is true."""
    log = simulate(preset("office", {"drive": {"duration": 30.0}}), 2)
    assert log.rig.rfid is not None
    antennas = {k: a.model_copy(update={"yaw": a.yaw - 0.15}) for k, a in log.rig.rfid.all_antennas().items()}
    return short_logs.with_reader(log, preset=None, antennas=antennas, time_offset=0.1)


def tags_kidnapped() -> Log:
    log = simulate(preset("office", {"drive": {"duration": 60.0}}), 1)
    return join(cut(log, 0.0, 6.0), cut(log, 50.0, 60.0))


def tags_read_late() -> Log:
    """Reads are older than their scans say, and each other scan arrives after the one that follows it."""
    log = short_logs.office()
    return short_logs.late(with_stream(log, "rfid", age=log.streams["rfid"].age + 0.05), "rfid")


def points_kidnapped() -> Log:
    return join(cut(room(), 0.0, 3.0), cut(camera_world.simulate(seed=3, seconds=24.0), 20.0, 24.0))


def points_with_wrong_names() -> Log:
    log, rng = room(), np.random.default_rng(4)
    seen = log.streams["sightings"]
    bad = rng.random(len(seen.t)) < 0.4
    return with_sightings(log, point=np.where(bad, rng.choice(log.world.points.names, len(bad)), seen.point).tolist())


def points_with_gap() -> Log:
    """Nothing in view in 2 to 5 s."""
    t = room().streams["sightings"].t
    return with_sightings(room(), (t < 2.0) | (t >= 5.0))


def points_of_uncertain_map() -> Log:
    points = room().world.points
    spread = np.broadcast_to(np.diag((0.03, 0.03, 0.01)) ** 2, (len(points), 3, 3))
    return replace(room(), world=World(points=replace(points, covariances=spread)))


def points_half_known() -> Log:
    """Half of the points are missing in the map."""
    points, half = room().world.points, len(room().world.points) // 2
    return replace(room(), world=World(points=PointMap.of(points.names[half:], points.positions[half:])))


def points_by_unknown_camera() -> Log:
    return with_camera(
        room(),
        pitch=camera_world.CAMERA.pitch + 0.03,
        yaw=0.03,
        fx=1.05 * camera_world.CAMERA.fx,
        uncertainty=CameraUncertainty(x=0.06, pitch=0.03, yaw=0.03, focal=0.05, time_offset=0.05),
    )


def markers() -> Log:
    """Corners of markers on the four walls of the room."""
    half, log = camera_world.HALF, room()
    places = (
        (half, 1.0, np.pi),
        (half, -1.5, np.pi),
        (1.2, half, -np.pi / 2),
        (-half, 0.5, 0.0),
        (-0.8, -half, np.pi / 2),
    )
    made = {
        f"m{i}": Marker(x=x, y=y, z=1.1, size=0.4, facing=facing, sigma=0.002)
        for i, (x, y, facing) in enumerate(places)
    }
    points = corner_points(made)
    t = np.arange(0.13, log.reference.t[-1], 0.2)
    seen = camera_world.sightings(log.reference, points, t, np.random.default_rng(8))
    return replace(log, world=World(points=points), streams={**log.streams, "sightings": seen})


def fault(name: str) -> Log:
    """An office with tags and landmarks, with one of the faults of :mod:`absurd_logs`."""
    return absurd_logs.FAULTS[name](absurd_logs.whole(), np.random.default_rng(1))


@cache
def recorded(name: str, start: float, seconds: float) -> Log:
    """A part of a recorded log; it begins ``start`` [s] after the log."""
    log = recorded_log(name)
    first = log.span()[0] + start
    return cut(log, first, first + seconds)


def aisle() -> Log:
    """Six seconds between shelves, with the tags of the map that are read most, as tables of each tag take time."""
    log = recorded("rfid-aisle-run13", 10.0, 6.0)
    counts = Counter(epc for epc in log.streams["rfid"].epc if epc in log.world.tags)
    tags = {epc: log.world.tags[epc] for epc, _ in counts.most_common(5)}
    return replace(log, world=log.world.model_copy(update={"tags": tags}))

"""A room whose walls carry named points, and a robot with a camera that drives in it: noise as the rig says."""

from dataclasses import replace

import changed_logs
import numpy as np
from drives import driven, slipped

from factorgraph_loc import CameraFrame, Log, PointMap, Rig, Trajectory, VelocityStream, World
from factorgraph_loc.sensors.camera.measurement import FeatureStream, SightingStream
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.odometry.settings import GrowthSettings, OdometryNoise, OdometrySettings
from factors.camera import model as reprojection

ODOMETRY_STEP = 0.05  # s
HALF = 4.0  # m: the room is a square of twice that
NOISE = OdometryNoise(
    along=GrowthSettings(per_distance=0.05),
    lateral=GrowthSettings(per_distance=0.02),
    heading=GrowthSettings(per_distance=0.05, per_rotation=0.05),
)
CAMERA = CameraSettings(
    fx=500.0, fy=500.0, cx=319.5, cy=239.5, distortion=(-0.1, 0.01, 0.001, -0.001), x=0.15, y=0.05, z=0.9, pitch=-0.1
)
RIG = Rig(sensors=("odometry", "sightings"), odometry=OdometrySettings(noise=NOISE), camera=CAMERA)


def on_walls(rng, count):
    """Places (N, 3) on the four walls."""
    along, height = rng.uniform(-HALF, HALF, count), rng.uniform(0.3, 2.4, count)
    wall = np.arange(count) % 4
    x = np.choose(wall, (along, along, HALF, -HALF))
    y = np.choose(wall, (HALF, -HALF, along, along))
    return np.column_stack((x, y, height))


def pointed(places):
    """A map of points at these places (N, 3)."""
    return PointMap.of(tuple(f"p{i}" for i in range(len(places))), places)


def room(count=160, seed=0):
    """Points on the four walls."""
    return pointed(on_walls(np.random.default_rng(seed), count))


def circle(t):
    """1.5 m radius at 0.3 m/s."""
    return np.full(len(t), 0.3), np.full(len(t), 0.2)


def weave(t):
    """The same circle, turning now more and now less, now faster and now slower."""
    return 0.3 + 0.15 * np.sin(0.9 * t), 0.2 + 0.5 * np.sin(1.3 * t)


def drive(seconds, rng, speeds=circle):
    """The robot slips off what the wheels report by the noise of the rig."""
    t = np.arange(round(seconds / ODOMETRY_STEP) + 1) * ODOMETRY_STEP
    v, w = speeds(t)
    moves = slipped(v, w, ODOMETRY_STEP, NOISE, rng)[:-1]
    return VelocityStream(t, v, w), Trajectory(t, driven(moves, (1.0, -1.0, 0.0)))


def sightings(truth, points, t, rng, camera=CAMERA, limit=20):
    """What the camera sees at times (N,) of the points that are in its image, at most ``limit`` in each."""
    model = camera.model()
    stamps, names, pixels = [], [], []
    for stamp, pose in zip(t, truth.at(t), strict=True):
        seen, depth = reprojection.predict(model, pose, points.positions)
        rows = np.flatnonzero(model.contains(seen) & (depth > 0.3))
        rows = rng.permutation(rows)[:limit]
        stamps += [stamp] * len(rows)
        names += [points.names[i] for i in rows]
        pixels.append(seen[rows] + camera.pixel_sigma * rng.standard_normal((len(rows), 2)))
    u, v = np.concatenate(pixels).T
    return SightingStream(np.array(stamps), names, u, v)


def simulate(seed=1, seconds=20.0, rate=5.0, limit=20, camera=CAMERA, speeds=circle, points=None):
    """A log; ``camera``: as it is in truth, which the log's rig need not know."""
    rng = np.random.default_rng(seed)
    odometry, truth = drive(seconds, rng, speeds)
    points = room() if points is None else points
    stream = sightings(truth, points, np.arange(0.13, seconds, 1.0 / rate), rng, camera, limit)
    return Log(
        name="room",
        rig=RIG,
        world=World(points=points),
        streams={"odometry": odometry, "sightings": stream},
        reference=truth,
    )


def with_sightings(log, keep=None, **columns):
    """The log with other columns of its sightings, or without some rows."""
    log = changed_logs.with_stream(log, "sightings", **columns)
    return log if keep is None else changed_logs.rows(log, "sightings", np.flatnonzero(keep))


def with_camera(log, **changes):
    """The log with another belief about the camera."""
    return changed_logs.with_rig(log, "camera", **changes)


def _descriptors(rng, count, binary):
    return rng.integers(0, 256, (count, 32), dtype=np.uint8) if binary else rng.standard_normal((count, 64))


def _again(descriptors, rng):
    """The same descriptors with noise: in binary ones a few bits change."""
    if descriptors.dtype == np.uint8:
        return descriptors ^ (rng.random(descriptors.shape) < 0.1).astype(np.uint8)
    return (descriptors + 0.2 * rng.standard_normal(descriptors.shape)).astype(np.float32)


def with_views(points, views=3, *, binary=False):
    """The same points with descriptors: each was seen from about the middle of the room, and looks nearly the same each time."""
    rng = np.random.default_rng(0)
    looks = _descriptors(rng, len(points), binary)
    owners = np.repeat(np.arange(len(points)), views)
    middle = np.append(rng.uniform(-1.5, 1.5, (len(owners), 2)), np.full((len(owners), 1), 0.9), axis=1)
    return replace(
        points,
        feature="orb" if binary else "colour",
        owners=owners,
        descriptors=_again(looks[owners], rng),
        seen_from=middle,
    )


def frame(points, pose, t, rng, camera=CAMERA, clutter=100, wrong=0.0, limit=400):
    """Features of the points in view, in random order, with some that show none of them; a share of the points look like others."""
    model = camera.model()
    seen, depth = reprojection.predict(model, pose, points.positions)
    rows = rng.permutation(np.flatnonzero(model.contains(seen) & (depth > 0.3)))[:limit]
    looks = points.descriptors[np.searchsorted(points.owners, rows)].copy()
    swapped = rng.permutation(len(rows))[: int(wrong * len(rows))]
    looks[swapped] = looks[np.roll(swapped, 1)]
    pixels = seen[rows] + camera.pixel_sigma * rng.standard_normal((len(rows), 2))
    pixels = np.concatenate((pixels, rng.uniform((0, 0), (camera.width, camera.height), (clutter, 2))))
    others = _descriptors(rng, clutter, looks.dtype == np.uint8)
    looks = _again(np.concatenate((looks, others)), rng)
    order = rng.permutation(len(pixels))
    shown = np.concatenate((rows, np.full(clutter, -1)))[order]
    found = CameraFrame(
        t,
        points.feature,
        pixels[order],
        looks[order],
        np.arange(len(pixels)),
    )
    return found, shown


def with_frames(log, seed=2, rate=5.0, wrong=0.0, clutter=100):
    """The same log with frames of features in place of named sightings."""
    rng = np.random.default_rng(seed)
    points = with_views(log.world.points)
    t = np.arange(0.13, log.reference.t[-1], 1.0 / rate)
    frames = [
        frame(points, p, s, rng, clutter=clutter, wrong=wrong)[0] for s, p in zip(t, log.reference.at(t), strict=True)
    ]
    streams = {"odometry": log.streams["odometry"], "camera": FeatureStream(t, frames)}
    rig = log.rig.model_copy(update={"sensors": ("odometry", "camera")})
    return replace(log, rig=rig, world=World(points=points), streams=streams)


def with_tracks(log, lifetime, seed=5, points=None, begin=0.13, every=0.3, clutter=60):
    """The log with features in place of named points, in an image ``every`` so many seconds, and no map; each is followed for
    ``lifetime`` [s]."""
    rng = np.random.default_rng(seed)
    points = with_views(room()) if points is None else points
    t = np.arange(begin, log.reference.t[-1], every)
    frames = []
    for k, (stamp, pose) in enumerate(zip(t.tolist(), log.reference.at(t), strict=True)):
        found, shown = frame(points, pose, stamp, rng, clutter=clutter)
        alone = 10**6 + 1000 * k + np.arange(len(shown))
        frames.append(replace(found, tracks=np.where(shown < 0, alone, shown + 1000 * int(stamp / lifetime))))
    streams = {"odometry": log.streams["odometry"], "camera": FeatureStream(t, frames)}
    rig = log.rig.model_copy(update={"sensors": ("odometry", "camera")})
    return replace(log, rig=rig, streams=streams, world=World())

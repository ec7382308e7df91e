"""A vehicle with two cameras that moves in space in front of named points, with noise as its rig says."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory3 import Trajectory3
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.stream import FeatureStream, RightSightingStream, SightingStream
from factorgraph_loc.sensors.inertial.measurement import InertialStream
from factorgraph_loc.sensors.inertial.settings import InertialSettings
from factorgraph_loc.sensors.twist.measurement import TwistStream
from factorgraph_loc.sensors.twist.settings import TwistSettings
from factorgraph_loc.vision.frame import CameraFrame
from factors.camera.model import linearize_in_space

STEP, SECONDS, SIGMA = 0.1, 8.0, 2.0
SHIFT, TURN = (0.02, 0.03, 0.04), (0.03, 0.02, 0.05)
LENS = {"fx": 450.0, "fy": 450.0, "cx": 320.0, "cy": 240.0, "pixel_sigma": SIGMA}
RIG = Rig(
    sensors=("twist", "sightings", "sightings_right"),
    twist=TwistSettings(shift=SHIFT, turn=TURN),
    camera=CameraSettings(x=0.05, y=0.1, roll=0.1, pitch=0.2, **LENS),
    camera_right=CameraSettings(x=0.05, y=-0.1, roll=0.1, pitch=0.2, **LENS),
)
RIG_INERTIAL = RIG.model_copy(
    update={
        "sensors": ("inertial", "sightings"),
        "inertial": InertialSettings(
            x=0.1,
            y=-0.05,
            z=0.02,
            roll=0.1,
            pitch=-0.2,
            yaw=0.5,
            force_noise=0.01,
            turn_noise=1e-3,
            force_walk=2e-3,
            turn_walk=2e-4,
            force_bias=0.2,
            turn_bias=0.02,
        ),
    }
)
ROWS = 200.0  # rows of the inertial unit a second
SWAYING = 6.0  # s
POINTS = np.random.default_rng(11).uniform((2.0, -2.0, -1.5), (4.0, 2.0, 1.0), (15, 3))
WORLD = World(points=PointMap.of([f"p{i}" for i in range(len(POINTS))], POINTS))


def carried(seed):
    """A vehicle that sways and turns about all axes in front of 15 points, which both cameras see; its motion is measured."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(SECONDS / STEP) + 1) * STEP
    v = np.column_stack((0.3 * np.cos(t), 0.4 * np.sin(0.7 * t), 0.2 * np.cos(1.3 * t)))
    w = np.column_stack((0.3 * np.cos(1.1 * t), 0.2 * np.sin(0.9 * t), 0.3 * np.cos(0.8 * t)))
    noise = rng.standard_normal((2, len(t), 3))
    true_v = v + noise[0] * SHIFT / np.sqrt(STEP)
    true_w = w + noise[1] * TURN / np.sqrt(STEP)
    positions, rotations = [np.zeros(3)], [np.eye(3)]
    for i in range(len(t) - 1):
        half = Rotation.from_rotvec(true_w[i] * STEP / 2.0).as_matrix()
        positions.append(positions[-1] + rotations[-1] @ half @ true_v[i] * STEP)
        rotations.append(rotations[-1] @ half @ half)
    truth = Trajectory3(t, np.array(positions), np.array(rotations))
    return Log("carried", RIG, WORLD, {"twist": TwistStream(t, v, w)} | seen_along(truth, rng), reference3=truth)


def swayed(seed, **settings):
    """A vehicle that starts at rest and sways, with an inertial unit that is turned and 10 cm from its origin; ``settings``: of the
    unit, where they differ."""
    rng, unit = np.random.default_rng(seed), RIG_INERTIAL.inertial.model_copy(update=settings)
    t = np.arange(round(SWAYING / STEP) + 1) * STEP
    rows = np.arange(round(SWAYING * ROWS) + 1) / ROWS
    turn = Rotation.from_euler("ZYX", (unit.yaw, unit.pitch, unit.roll))
    arm = np.array((unit.x, unit.y, unit.z))
    small = 1e-4
    before, here, after = (along(rows + shift) for shift in (-small, 0.0, small))
    ahead, there, behind = ((p + r.apply(arm)) for p, r in (after, here, before))
    up = np.array((0.0, 0.0, unit.gravity))
    force = (here[1] * turn).inv().apply((ahead - 2.0 * there + behind) / small**2 + up)
    rate = turn.inv().apply((before[1].inv() * after[1]).as_rotvec() / (2.0 * small))
    values = np.hstack((force, rate))
    for part, bias, noise, walk in (
        (slice(0, 3), unit.force_bias, unit.force_noise, unit.force_walk),
        (slice(3, 6), unit.turn_bias, unit.turn_noise, unit.turn_walk),
    ):
        drift = walk / np.sqrt(ROWS) * rng.standard_normal((len(rows), 3)).cumsum(axis=0)
        values[:, part] += bias * rng.standard_normal(3) + drift
        values[:, part] += noise * np.sqrt(ROWS) * rng.standard_normal((len(rows), 3))
    positions, rotations = along(t)
    truth = Trajectory3(t, positions, rotations.as_matrix())
    streams = {"inertial": InertialStream(rows, *values.T)} | seen_along(truth, rng)
    rig = RIG_INERTIAL.model_copy(update={"inertial": unit})
    return Log("swayed", rig, WORLD, streams, reference3=truth)


def along(t):
    """Positions (N, 3) and rotations of the vehicle that sways."""
    positions = (1.0 - np.cos(np.outer(t, (1.1, 0.9, 1.3)))) * (0.2, 0.3, 0.1)
    return positions, Rotation.from_euler("ZYX", np.sin(np.outer(t, (0.8, 0.9, 1.1))) * (0.3, 0.2, 0.2))


def seen_along(truth, rng):
    """The streams of both cameras along a trajectory, from its second pose."""
    positions, rotations, t, streams = truth.positions, truth.rotations, truth.t, {}
    names = [f"p{i}" for i in range(len(POINTS))]
    for sensor, kind, settings in (
        ("sightings", SightingStream, RIG.camera),
        ("sightings_right", RightSightingStream, RIG.camera_right),
    ):
        model, rows, seen = settings.model(), [], []
        for k in range(1, len(t)):
            camera = positions[k] + rotations[k] @ model.position
            pixels, *_ = linearize_in_space(model, camera, rotations[k] @ model.rotation, POINTS)
            ahead = ((POINTS - camera) @ rotations[k] @ model.rotation)[:, 2] > 0.3
            visible = np.flatnonzero(ahead & model.contains(pixels))
            rows += [(k, i) for i in visible.tolist()]
            seen.append(pixels[visible] + SIGMA * rng.standard_normal((len(visible), 2)))
        k, i = np.array(rows).T
        streams[sensor] = kind(t[k], [names[j] for j in i.tolist()], *np.concatenate(seen).T)
    return streams


def with_features(log, tempering):
    """What the left camera sees has no name, but looks like what was seen of the same point from the start."""
    rng = np.random.default_rng(12)
    looks = rng.standard_normal((len(POINTS), 64)).astype(np.float32)
    rows, seen = np.arange(len(POINTS)), log.streams["sightings"]
    points = replace(
        PointMap.of([f"p{i}" for i in rows], POINTS),
        feature="colour",
        owners=rows,
        descriptors=looks,
        seen_from=np.zeros((len(rows), 3)),
        sizes=np.full(len(rows), 5.0),
    )
    t, frames = np.unique(seen.t), []
    for stamp in t.tolist():
        at = np.flatnonzero(seen.t == stamp)
        which = np.array([int(seen.point[i][1:]) for i in at])
        pixels = np.column_stack((seen.u[at], seen.v[at]))
        frames.append(CameraFrame(stamp, "colour", pixels, np.full(len(at), 5.0), looks[which], which))
    camera = log.rig.camera.model_copy(update={"tempering": tempering})
    rig = log.rig.model_copy(update={"sensors": ("twist", "camera"), "camera": camera})
    streams = {"twist": log.streams["twist"], "camera": FeatureStream(t, frames)}
    return replace(log, rig=rig, world=World(points=points), streams=streams)

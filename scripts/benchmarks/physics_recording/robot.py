"""A robot with two driven wheels and a castor on an uneven floor: contact, slip and motors are those of the physics engine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pybullet
from pybullet_utils.bullet_client import BulletClient

from physics_recording.room import DEPTH, WIDTH
from physics_recording.textures import noise

RADII = (0.0806, 0.0798)  # m; the drawing says 0.08 and 0.36
TRACK = 0.356
RADIUS, NOMINAL_TRACK = 0.08, 0.36
TICKS = 2048  # of an encoder, per turn
STEP = 1.0 / 480.0  # s
EVERY = 8  # steps from one row of the encoders to the next
CELL = 0.1  # m, of the floor
UNEVEN = 0.006  # m, standard deviation of its height
WET = ((2.0, 1.6, 0.6), (8.6, 5.9, 0.7), (3.4, 6.2, 0.5))  # x, y, radius [m] where the floor is slippery
DRY_FRICTION, WET_FRICTION = 0.9, 0.06
SPEED, TURN = 0.45, 0.8  # m/s, rad/s: what the joystick asks for at most
GAIN, SPEED_CHANGE, TURN_CHANGE = 1.6, 0.6, 2.5  # of the turn rate per angle; m/s^2, rad/s^2
NEAR = 0.3  # m from a waypoint
REST, RESTS = 4.0, 5  # s, at every fifth waypoint

URDF = """<robot name="cart">
 <link name="base">
  <inertial>
   <mass value="9"/><origin xyz="-0.04 0 0.06"/><inertia ixx=".12" iyy=".15" izz=".2" ixy="0" ixz="0" iyz="0"/>
  </inertial>
 </link>
 {wheels}
 <link name="castor">
  <inertial><mass value=".3"/><inertia ixx=".001" iyy=".001" izz=".001" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><geometry><sphere radius=".04"/></geometry></collision>
 </link>
 <joint name="castor" type="fixed">
  <parent link="base"/><child link="castor"/><origin xyz="-0.22 0 {castor}"/>
 </joint>
</robot>"""
WHEEL = """<link name="{name}">
  <inertial><mass value=".6"/><inertia ixx=".002" iyy=".002" izz=".003" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><geometry><cylinder radius="{radius}" length=".02"/></geometry></collision>
 </link>
 <joint name="{name}" type="continuous">
  <parent link="base"/><child link="{name}"/><origin xyz="0 {y} 0" rpy="-1.5708 0 0"/><axis xyz="0 0 1"/>
 </joint>"""


@dataclass(frozen=True)
class Motion:
    """What happened, in steps of :data:`STEP`: ``positions`` (N, 3) of the middle between the wheels, on the floor; ``rotations``
    (N, 4), quaternions x, y, z, w; ``angles`` (N, 2) of the left and right wheel [rad]."""

    positions: np.ndarray
    rotations: np.ndarray
    angles: np.ndarray


def drive(route: Sequence[tuple[float, float]], duration: float, seed: int, folder: Path) -> Motion:
    """Drive along waypoints, again and again, for ``duration`` [s]; ``folder``: for files."""
    engine = BulletClient(pybullet.DIRECT)
    engine.setGravity(0.0, 0.0, -9.81)
    engine.setTimeStep(STEP)
    engine.setPhysicsEngineParameter(numSolverIterations=100)
    _floor(engine, np.random.default_rng(1000))  # the same every day
    body = _robot(engine, route, folder)
    rng = np.random.default_rng(seed)
    positions, rotations, angles = [], [], []
    wanted, asked, target, rest = np.zeros(2), np.zeros(2), 1, REST
    for _ in range(round((duration + 1.0) / STEP)):
        position, rotation = engine.getBasePositionAndOrientation(body)
        place, turned = engine.multiplyTransforms(position, rotation, (0.04, 0.0, -0.06 - RADIUS), (0, 0, 0, 1))
        positions.append(place)
        rotations.append(turned)
        angles.append([engine.getJointState(body, wheel)[0] for wheel in (0, 1)])
        heading = engine.getEulerFromQuaternion(rotation)[2]
        way = np.array(route[target % len(route)]) - place[:2]
        if np.hypot(*way) < NEAR:
            target += 1
            rest = REST if target % RESTS == 0 else 0.0
        if rest > 0.0:
            rest -= STEP
            asked = np.zeros(2)
        else:
            off = (np.arctan2(way[1], way[0]) - heading + np.pi) % (2 * np.pi) - np.pi
            asked = np.array((SPEED * max(np.cos(off), 0.0) ** 3, np.clip(GAIN * off, -TURN, TURN)))
            asked = asked + rng.normal(0.0, (0.02, 0.05))  # nobody holds a joystick still
        limit = np.array((SPEED_CHANGE, TURN_CHANGE)) * STEP
        wanted = wanted + np.clip(asked - wanted, -limit, limit)
        friction = WET_FRICTION if any(np.hypot(place[0] - x, place[1] - y) < r for x, y, r in WET) else DRY_FRICTION
        for wheel, side in ((0, -1.0), (1, 1.0)):
            rate = (wanted[0] + side * wanted[1] * NOMINAL_TRACK / 2.0) / RADIUS
            engine.changeDynamics(body, wheel, lateralFriction=friction)
            engine.setJointMotorControl2(body, wheel, engine.VELOCITY_CONTROL, targetVelocity=rate, force=3.0)
        engine.stepSimulation()
    engine.disconnect()
    skip = round(1.0 / STEP)  # it falls onto the floor first
    return Motion(*(np.array(values)[skip:] for values in (positions, rotations, angles)))


def _floor(engine: BulletClient, rng: np.random.Generator) -> None:
    rows, columns = round((DEPTH + 2.0) / CELL) + 1, round((WIDTH + 2.0) / CELL) + 1
    heights = UNEVEN * noise((rows, columns), rng, (6, 10, 25))
    shape = engine.createCollisionShape(
        engine.GEOM_HEIGHTFIELD,
        meshScale=(CELL, CELL, 1.0),
        heightfieldData=heights.ravel().tolist(),
        numHeightfieldRows=columns,
        numHeightfieldColumns=rows,
    )
    middle = (WIDTH / 2.0, DEPTH / 2.0, (heights.max() + heights.min()) / 2.0)
    floor = engine.createMultiBody(0, shape, basePosition=middle)
    engine.changeDynamics(floor, -1, lateralFriction=1.0, restitution=0.0)


def _robot(engine: BulletClient, route: Sequence[tuple[float, float]], folder: Path) -> int:
    names = ("left", "right")
    wheels = "\n".join(
        WHEEL.format(name=name, radius=radius, y=side * TRACK / 2.0)
        for name, radius, side in zip(names, RADII, (1.0, -1.0), strict=True)
    )
    path = folder / "cart.urdf"
    path.write_text(URDF.format(wheels=wheels, castor=0.04 - RADIUS))
    (ax, ay), (bx, by) = route[:2]
    facing = engine.getQuaternionFromEuler((0.0, 0.0, float(np.arctan2(by - ay, bx - ax))))
    body = engine.loadURDF(str(path), (ax, ay, RADIUS + 0.03), facing)
    engine.changeDynamics(body, 2, lateralFriction=0.02)
    for link in (0, 1, 2):
        engine.changeDynamics(body, link, restitution=0.0, rollingFriction=0.0)
    return int(body)

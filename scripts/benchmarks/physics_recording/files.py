"""The files of two drives, as the programs of a robot and of a motion capture system might write them."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from physics_recording.filming import FOCAL, SIZE, record
from physics_recording.robot import EVERY, NOMINAL_TRACK, RADIUS, STEP, TICKS, Motion, drive

ROUTES = (
    ((1.5, 1.5), (9.3, 1.6), (9.3, 6.3), (1.6, 6.4), (1.5, 1.7), (1.7, 6.2), (9.1, 6.1), (9.0, 1.9), (1.8, 2.0)),
    (
        (9.0, 6.2),
        (2.2, 5.9),
        (1.8, 1.9),
        (5.0, 2.1),
        (9.1, 1.7),
        (8.9, 5.0),
        (9.0, 2.2),
        (4.5, 1.6),
        (1.4, 2.5),
        (1.9, 6.1),
        (6.0, 6.2),
    ),
)
NAMES = ("monday", "tuesday")
STARTS = (1_730_000_000.0, 1_730_090_000.0)  # s since 1970
REFERENCE = 12  # steps from one pose of the motion capture to the next

RIG = """name = "cart"
sensors = ["odometry", "camera"]

[odometry.wheels]
radius = {radius}
track = {track}

[camera]
width = {width}
height = {height}
fx = {focal}
fy = {focal}
cx = {cx}
cy = {cy}
x = 0.12
z = 0.65
"""
MANIFEST = """title = "A cart in a furnished room, {name}: made by the physics engine pybullet, not by a real robot"
reader = "mapped"
path = "{name}"
rig = "cart.rig.toml"
licence = "none needed"
origin = "scripts/benchmarks/record_physics"

[options.odometry]
file = "encoders.csv"
separator = ";"
columns = {{ t = "time", left_angle = "left", right_angle = "right" }}
units = {{ t = "ms", left_angle = {tick:.10f}, right_angle = {tick:.10f} }}

[options.camera]
file = "images.csv"
folder = "images"
columns = {{ t = "time", file = "image" }}
units = {{ t = "s" }}

[options.reference]
file = "mocap.txt"
format = "tum"
"""


def write_recording(day: int, duration: float, out: Path) -> None:
    """Drive and film on one of the two days, and write ``out``/NAME and ``out``/NAME.toml."""
    name, start = NAMES[day], STARTS[day]
    folder = out / name
    (folder / "images").mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as files:
        motion = drive(ROUTES[day], duration, day, Path(files))
    _write_wheels(motion, start, folder / "encoders.csv")
    _write_reference(motion, start, folder / "mocap.txt")
    stamps = record(motion, day, day, folder / "images")
    rows = [f"{start + t:.6f},{i:05d}.jpg" for i, t in enumerate(stamps.tolist())]
    (folder / "images.csv").write_text("\n".join(["time,image", *rows, ""]))
    wide, high = SIZE  # the renderer looks through corners of pixels, not through their middles
    rig = RIG.format(
        radius=RADIUS, track=NOMINAL_TRACK, width=wide, height=high, focal=FOCAL, cx=wide / 2, cy=high / 2 - 1.0
    )
    (out / "cart.rig.toml").write_text(rig)
    (out / f"{name}.toml").write_text(MANIFEST.format(name=name, tick=2.0 * np.pi / TICKS))


def _write_wheels(motion: Motion, start: float, path: Path) -> None:
    ticks = np.floor(motion.angles[::EVERY] * TICKS / (2.0 * np.pi)).astype(int)
    rows = [f"{1e3 * (start + i * EVERY * STEP):.1f};{a};{b}" for i, (a, b) in enumerate(ticks.tolist())]
    path.write_text("\n".join(["time;left;right", *rows, ""]))


def _write_reference(motion: Motion, start: float, path: Path) -> None:
    rows = ["# timestamp x y z qx qy qz qw"]
    poses = np.hstack((motion.positions, motion.rotations))[::REFERENCE]
    for i, pose in enumerate(poses):
        values = " ".join(f"{value:.6f}" for value in pose)
        rows.append(f"{start + i * REFERENCE * STEP:.6f} {values}")
    path.write_text("\n".join([*rows, ""]))

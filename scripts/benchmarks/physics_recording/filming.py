"""What the robot's camera records: motion blur, a rolling shutter, an exposure that follows the light, noise and compression."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pybullet
from pybullet_utils.bullet_client import BulletClient
from scipy.spatial.transform import Rotation

from physics_recording.robot import STEP, Motion
from physics_recording.room import DAYS, Day, Room

SIZE = (480, 360)  # px
FOCAL = 370.0  # px
NEAR, FAR = 0.05, 25.0  # m
PLACE = (0.118, 0.004, 0.652)  # m, on the robot
TILT = (0.003, 0.012, -0.006)  # rad: roll, pitch (down is positive), yaw
RATE = 5.0  # images/s
READOUT = 0.024  # s from the first row to the last
PARTS = 3  # renderings of an image, at different times and at different parts of a pixel
SHIFTS = ((-0.33, -0.33), (0.0, 0.33), (0.33, 0.0))  # px
BRIGHT = 118.0  # grey level on average that the exposure aims at
SLOW = 0.25  # share of that which it reaches from image to image
NOISE = 2.0  # grey levels at mean brightness
STAMP = 0.001  # s, jitter of the stamps
QUALITY = 88  # JPEG


def record(motion: Motion, day: int, seed: int, folder: Path) -> np.ndarray:
    """Write the images into ``folder``; the stamps (N,) [s] from the start of the motion."""
    engine = BulletClient(pybullet.DIRECT)
    with tempfile.TemporaryDirectory() as files:
        Room(engine, DAYS[day], Path(files)).build(seed=3)
    rng = np.random.default_rng(seed)
    times = np.arange(0.1, (len(motion.positions) - 1) * STEP - 0.1, 1.0 / RATE)
    gain = None
    for i, t in enumerate(times.tolist()):
        light = exposed(engine, motion, t, DAYS[day])
        wanted = BRIGHT / max(float(light.mean()), 1.0)
        gain = wanted if gain is None else gain * (wanted / gain) ** SLOW
        cv2.imwrite(str(folder / f"{i:05d}.jpg"), developed(light, gain, rng), (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
    engine.disconnect()
    return np.asarray(times + STAMP * rng.standard_normal(len(times)))


def exposed(engine: Any, motion: Motion, t: float, day: Day) -> np.ndarray:
    """The light (H, W, 3) BGR that falls on the sensor, whose middle row is exposed around ``t``."""
    rows = (np.arange(SIZE[1]) / (SIZE[1] - 1) - 0.5) * READOUT
    span = READOUT + day.exposure
    offsets = ((np.arange(PARTS) + 0.5) / PARTS - 0.5) * span
    weights = np.clip((day.exposure + span / PARTS) / 2.0 - np.abs(rows[:, None] - offsets), 0.0, span / PARTS)
    weights /= weights.sum(axis=1, keepdims=True)
    parts = [rendered(engine, motion, t + offset, day, shift) for offset, shift in zip(offsets, SHIFTS, strict=True)]
    return np.asarray(np.einsum("hk,khwc->hwc", weights, np.stack(parts).astype(np.float32)))


def rendered(engine: Any, motion: Motion, t: float, day: Day, shift: tuple[float, float]) -> np.ndarray:
    """What a pinhole camera would see at one moment, moved by parts of a pixel."""
    (wide, high), n = SIZE, NEAR / FOCAL
    u, v = shift
    lens = engine.computeProjectionMatrix(
        (-wide / 2 - u) * n, (wide / 2 - u) * n, (-high / 2 + v) * n, (high / 2 + v) * n, NEAR, FAR
    )
    k = min(max(t / STEP, 0.0), len(motion.positions) - 1.001)
    i, share = int(k), k - int(k)
    place = (1.0 - share) * motion.positions[i] + share * motion.positions[i + 1]
    robot = Rotation.from_quat(motion.rotations[[i, i + 1]].T @ (1.0 - share, share))
    roll, pitch, yaw = TILT
    camera = robot * Rotation.from_euler("ZYX", (yaw, pitch, roll))
    eye = place + robot.apply(PLACE)
    sight, up = camera.apply(((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    _, _, pixels, _, _ = engine.getCameraImage(
        wide,
        high,
        engine.computeViewMatrix(eye, eye + sight, up),
        lens,
        lightDirection=day.light,
        lightColor=day.colour,
        lightDistance=20.0,
        lightAmbientCoeff=day.ambient,
        lightDiffuseCoeff=day.diffuse,
        lightSpecularCoeff=0.05,
        shadow=0,
        flags=engine.ER_NO_SEGMENTATION_MASK,
        renderer=engine.ER_TINY_RENDERER,
    )
    return np.reshape(pixels, (high, wide, 4))[..., 2::-1]


def developed(light: np.ndarray, gain: float, rng: np.random.Generator) -> np.ndarray:
    """The image after vignetting, amplification and noise, which grows with both."""
    high, wide = light.shape[:2]
    y, x = np.mgrid[:high, :wide]
    edge = np.hypot(x - wide / 2, y - high / 2) / math.hypot(wide / 2, high / 2)
    values = light * (gain * (1.0 - 0.25 * edge**2)[..., None])
    values += NOISE * np.sqrt(gain * np.maximum(values, 4.0) / BRIGHT) * rng.standard_normal(values.shape)
    return np.asarray(np.clip(values, 0.0, 255.0).astype(np.uint8))

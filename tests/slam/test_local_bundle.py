"""The last keyframes and what waits there, adjusted together."""

import camera_world
import numpy as np

from factorgraph_loc.fusion.graph_parts import Keyframe
from factorgraph_loc.slam.local_bundle import bundled
from factorgraph_loc.slam.new_points import sightings_of
from factors import se2
from factors.camera import model as reprojection
from factors.motion import ChainState, Increment

MODEL = camera_world.CAMERA.model()
TURN = 0.015  # rad, that the odometry is off by from one keyframe to the next
STEPS = np.array((0.0, 0.4, 0.8, 1.2, 1.6))


def drive(rng, count=60, wrong=0.0):
    """True poses, keyframes, poses by odometry, and what waits: named points with noise of a pixel."""
    truth = np.column_stack((STEPS - 2.0, 0.0 * STEPS, 0.1 * STEPS))
    guess, keyframes = [truth[0]], [Keyframe(0, 0.0, ChainState(0.0, *truth[0], 0.0, 0.0, 0.0), None)]
    for k in range(1, len(truth)):
        moved = se2.compose(se2.between(truth[k - 1], truth[k]), np.array((0.0, 0.0, TURN * rng.standard_normal())))
        increment = Increment(moved, np.diag((0.01, 0.01, TURN)) ** 2, 0.6)
        keyframes.append(Keyframe(k, 0.6 * k, keyframes[0].odometry, increment))
        guess.append(se2.compose(guess[-1], moved))
    points, waiting = camera_world.room(4 * count), {}
    for k, pose in enumerate(truth):
        pixels, depth = reprojection.predict(MODEL, pose, points.positions)
        rows = np.flatnonzero(MODEL.contains(pixels) & (depth > 0.3))
        noisy = pixels[rows] + rng.standard_normal((len(rows), 2))
        bad = rng.random(len(rows)) < wrong
        noisy[bad] = rng.uniform((0.0, 0.0), (640.0, 480.0), (int(bad.sum()), 2))
        for row, sighting in zip(rows.tolist(), sightings_of(MODEL, k, noisy), strict=True):
            waiting.setdefault(row, []).append(sighting)
    slacks = [500.0 * TURN * np.sqrt(len(truth) - 1.0 - k) for k in range(len(truth))]
    return truth, keyframes, guess, slacks, waiting


def turn_errors(poses, truth):
    return np.abs(se2.wrap(np.array(poses)[:, 2] - truth[:, 2]))


def test_points_tell_the_turns_much_better_than_odometry():
    for wrong in (0.0, 0.1):
        for seed in range(4):
            truth, keyframes, guess, slacks, waiting = drive(np.random.default_rng(seed), wrong=wrong)
            found = bundled(MODEL, keyframes, guess, slacks, waiting)
            assert found is not None
            poses = [pose for pose, _ in found]
            np.testing.assert_allclose(poses[0], truth[0], atol=1e-3)
            assert turn_errors(poses, truth).max() < max(0.3 * turn_errors(guess, truth).max(), 0.008)


def test_few_points_tell_nothing():
    _, keyframes, guess, slacks, waiting = drive(np.random.default_rng(0))
    few = dict(list(waiting.items())[:6])
    assert bundled(MODEL, keyframes, guess, slacks, few) is None
    assert bundled(MODEL, keyframes[:2], guess[:2], slacks[:2], {}) is None

"""The last keyframes and what waits there, adjusted together."""

import camera_world
import numpy as np

from factorgraph_loc.fusion.graph.graph import Keyframe
from factorgraph_loc.fusion.graph.problem import Problem
from factorgraph_loc.slam.keyframe_cameras import LocalBundle, bundled
from factorgraph_loc.slam.new_points import sightings_of
from factors import se2
from factors.camera import model as reprojection
from factors.camera.point import PointFactor
from factors.graph import PriorFactor, VectorPriorFactor, point_key, pose_key, tilt_key
from factors.least_squares import descended
from factors.motion import ChainState, Increment
from factors.odometry.factor import OdometryFactor, OdometryStack

MODEL = camera_world.CAMERA.model()
TURN = 0.015  # rad, that the odometry is off by from one keyframe to the next
STEPS = np.array((0.0, 0.4, 0.8, 1.2, 1.6))


def drive(rng, wrong=0.0, slip=0.0):
    """True poses, keyframes, poses by odometry, which misses a turn ``slip`` [rad] in the third step, and what waits: named points
    with noise of a pixel."""
    truth = np.column_stack((STEPS - 2.0, 0.0 * STEPS, 0.1 * STEPS))
    guess, keyframes = [truth[0]], [Keyframe(0, 0.0, ChainState(0.0, *truth[0], 0.0, 0.0, 0.0), None)]
    for k in range(1, len(truth)):
        off = TURN * rng.standard_normal() - slip * (k == 3)
        moved = se2.compose(se2.between(truth[k - 1], truth[k]), np.array((0.0, 0.0, off)))
        increment = Increment(moved, np.diag((0.01, 0.01, TURN)) ** 2, 0.6)
        keyframes.append(Keyframe(k, 0.6 * k, keyframes[0].odometry, increment))
        guess.append(se2.compose(guess[-1], moved))
    points, waiting = camera_world.room(240), {}
    for k, pose in enumerate(truth):
        pixels, depth = reprojection.predict(MODEL, pose, points.positions)
        rows = np.flatnonzero(MODEL.contains(pixels) & (depth > 0.3))
        noisy = pixels[rows] + rng.standard_normal((len(rows), 2))
        bad = rng.random(len(rows)) < wrong
        noisy[bad] = rng.uniform((0.0, 0.0), (640.0, 480.0), (int(bad.sum()), 2))
        for row, sighting in zip(rows.tolist(), sightings_of(MODEL, k, noisy), strict=True):
            waiting.setdefault(row, []).append(sighting)
    return truth, keyframes, guess, waiting


def turn_errors(poses, truth):
    return np.abs(se2.wrap(np.array(poses)[:, 2] - truth[:, 2]))


def test_points_tell_the_turns_much_better_than_odometry():
    for wrong in (0.0, 0.1):
        for seed in range(4):
            truth, keyframes, guess, waiting = drive(np.random.default_rng(seed), wrong=wrong)
            found = bundled(MODEL, keyframes, guess, waiting)
            assert found is not None
            poses = [pose for pose, _ in found]
            np.testing.assert_allclose(poses[0], truth[0], atol=1e-3)
            assert turn_errors(poses, truth).max() < max(0.3 * turn_errors(guess, truth).max(), 0.008)


def test_points_tell_turns_that_slipping_wheels_miss():
    for slip in (-0.3, 0.3):
        for seed in range(4):
            truth, keyframes, guess, waiting = drive(np.random.default_rng(seed), slip=slip)
            found = bundled(MODEL, keyframes, guess, waiting)
            assert found is not None
            assert turn_errors([pose for pose, _ in found], truth).max() < 0.02


def test_keyframes_before_a_gap_in_what_is_seen_are_left_as_they_are():
    """Two tracks across the gap are wrong, and would turn what comes after."""
    truth, keyframes, guess, waiting = drive(np.random.default_rng(0))
    apart = {name: [s for s in seen if s.keyframe >= 2] for name, seen in waiting.items()}
    names = list(apart)
    for name, other in ((names[0], names[1]), (names[1], names[0])):
        apart[name] = waiting[other][:2] + waiting[name][2:]
    found = bundled(MODEL, keyframes, guess, apart)
    assert found is not None
    assert len(found) == 3
    np.testing.assert_allclose(found[0][0], guess[2], atol=1e-3)
    turned = se2.between(found[0][0], found[-1][0])[2] - se2.between(truth[2], truth[-1])[2]
    assert abs(turned) < 0.01


def test_few_points_tell_nothing():
    _, keyframes, guess, waiting = drive(np.random.default_rng(0))
    few = dict(list(waiting.items())[:6])
    assert bundled(MODEL, keyframes, guess, few) is None
    assert bundled(MODEL, keyframes[:2], guess[:2], {}) is None


def test_it_ends_where_the_general_solver_does():
    """The first pose is held there by a narrow prior."""
    rng = np.random.default_rng(1)
    truth, keyframes, guess, waiting = drive(rng)
    tilts = 0.01 * rng.standard_normal((len(truth), 2))
    names = list(waiting)[:12]
    starts = np.cumsum([0, *(len(waiting[name]) for name in names)])
    frames = np.array([s.keyframe for name in names for s in waiting[name]])
    points = camera_world.room(240).positions[names]
    steps = [k.from_previous for k in keyframes[1:]]
    lens, sigmas = reprojection.lens_of(MODEL), np.full(2, MODEL.tilt)
    pixels, values = [], {pose_key(k): pose for k, pose in enumerate(guess)}
    values |= {tilt_key(k): np.zeros(2) for k in range(len(truth))} | {point_key(p): x for p, x in enumerate(points)}
    factors = [(PriorFactor(guess[0], 1e-8 * np.eye(3)), (pose_key(0),))]
    factors += [(VectorPriorFactor(np.zeros(2), sigmas), (tilt_key(k),)) for k in range(len(truth))]
    factors += [(OdometryFactor(step), (pose_key(k), pose_key(k + 1))) for k, step in enumerate(steps)]
    for p, point in enumerate(points):
        for k in frames[starts[p] : starts[p + 1]].tolist():
            at = reprojection.camera_pose(MODEL, truth[k], tilts[k])
            pixels.append(reprojection.linearize_in_space(MODEL, *at, point[None])[0][0] + rng.standard_normal(2))
            factors.append((PointFactor(MODEL, lens, pixels[-1]), (pose_key(k), tilt_key(k), point_key(p))))
    odometry = OdometryStack([OdometryFactor(step) for step in steps], range(len(steps)), 0)
    owners = np.repeat(np.arange(len(names)), np.diff(starts))
    local = LocalBundle(MODEL, odometry, frames, owners, np.array(pixels))
    (poses, found, _), _, _ = descended(local.cost, local.moved, (np.array(guess), np.zeros((len(truth), 2)), points))
    solved = Problem(factors).solve(values).values
    np.testing.assert_allclose(poses, [solved[pose_key(k)] for k in range(len(truth))], atol=1e-4)
    np.testing.assert_allclose(found, [solved[tilt_key(k)] for k in range(len(truth))], atol=1e-4)

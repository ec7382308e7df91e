"""Motion of the monoSLAM filter: transitions against numerical ones, and what is measured against what is known."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.slam import monoslam_motion
from factorgraph_loc.slam.monoslam_invariance import carried
from factorgraph_loc.slam.monoslam_motion import (
    ROBOT,
    UNEVEN,
    Origin,
    RobotState,
    exp,
    on_the_floor,
    standstill,
    tilt_of,
)
from factorgraph_loc.slam.monoslam_sighting import agreeing
from factorgraph_loc.slam.monoslam_state import Innovation, MapPoint, SlamState, with_floor
from factors.camera import inverse_depth
from factors.camera.model import TiltScale
from factors.motion import ChainState

TILTED = RobotState(
    np.array((1.0, -2.0, 0.3)), exp(np.array((0.2, -0.1, 0.7))), np.array((0.3, 0.1, -0.2)), np.array((0.5, -0.4, 0.6))
)
LEVEL = RobotState(
    np.array((1.0, -2.0, 0.0)), exp(np.array((0.0, 0.0, 0.7))), np.array((0.3, 0.1, 0.0)), np.array((0.0, 0.0, 0.6))
)
MOTION = np.array((0.1, 0.02, 0.05)), np.diag((1e-4, 2e-4, 3e-4)), np.zeros((3, 0))
DT = 0.1
NOTHING = np.zeros(3)


def numerical(f, at):
    step = 1e-6
    reference = f(at)
    columns = [
        (f(at.plus(step * e)).minus(reference) - f(at.plus(-step * e)).minus(reference)) / (2 * step)
        for e in np.eye(12)
    ]
    return np.stack(columns, axis=1)


def test_the_error_is_carried_as_the_state_moves():
    def step(robot):
        return monoslam_motion.measured(robot, *MOTION, DT)

    np.testing.assert_allclose(step(TILTED).transition, numerical(lambda r: step(r).robot, TILTED), atol=1e-6)


def test_the_floor_carries_the_error_of_a_level_robot_as_stated():
    def step(robot):
        return monoslam_motion.on_the_floor(monoslam_motion.measured(robot, *MOTION, DT), DT, 0.01, 0.01, 1.0)

    np.testing.assert_allclose(step(LEVEL).transition, numerical(lambda r: step(r).robot, LEVEL), atol=2e-6)


def test_constants_move_a_robot_as_stated():
    def moved(change):
        delta = MOTION[0][:2].tolist()
        by = np.array(((0.1, 0.0), (0.02, 0.0), (0.0, 0.05)))
        return np.array((*delta, 0.05)) + rotated(by @ change), np.eye(3), by

    def rotated(local):  # a perturbation at the end, in the frame of the start
        return np.array((*(exp(np.array((0.0, 0.0, 0.05))) @ np.array((*local[:2], 0.0)))[:2], local[2]))

    transition = monoslam_motion.measured(LEVEL, *moved(np.zeros(2)), DT).transition
    for i, unit in enumerate(1e-6 * np.eye(2)):
        ahead, back = (monoslam_motion.measured(LEVEL, *moved(s * unit), DT).robot for s in (1, -1))
        np.testing.assert_allclose(transition[:, 12 + i], ahead.minus(back) / 2e-6, atol=1e-6)


def test_odometry_replaces_the_noise_of_what_it_measures_and_the_floor_holds_the_rest():
    """After long at rest with perfect odometry, height and tilt have the floor's deviations, and nothing else is uncertain."""
    still = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 0))
    robot, covariance = LEVEL, np.zeros((12, 12))
    for _ in range(100):
        step = monoslam_motion.on_the_floor(monoslam_motion.measured(robot, *still, DT), DT, 0.02, 0.03, 1.0)
        robot, covariance = step.robot, step.transition @ covariance @ step.transition.T + step.noise
    np.testing.assert_allclose(np.diag(covariance)[:6], (0.03**2, 0.03**2, 0, 0, 0, 0.02**2), atol=1e-9)
    moved = monoslam_motion.measured(LEVEL, *MOTION, DT)
    np.testing.assert_allclose(np.diag(moved.noise)[:6], (0, 0, 3e-4, 1e-4, 2e-4, 0), atol=1e-12)


def test_the_start_spreads_over_later_poses_and_points():
    origin = Origin(LEVEL, np.diag((0.0, 0.0, 0.1, 0.2, 0.2, 0.0)) ** 2)
    later = RobotState(LEVEL.position + np.array((3.0, 4.0, 0.0)), exp(np.array((0.0, 0.0, -1.0))), NOTHING, NOTHING)
    # a heading error of 0.1 rad moves what is 5 m away by 0.5 m, across
    assert np.trace(origin.of_pose(later)[3:, 3:]) == pytest.approx(0.5**2 + 2 * 0.2**2)
    assert np.trace(origin.of_point(later.position)) == pytest.approx(0.5**2 + 2 * 0.2**2)
    across = np.array((-0.8, 0.6, 0.0))
    assert across @ origin.of_point(later.position) @ across == pytest.approx(0.5**2 + 0.2**2)


CONSTANTS = 2
STEP = 1e-6


def state(rng, constants):
    """A robot with two points and two rays; ``constants`` (P,), of which the second scales distances."""
    ray = (1.0, 0.5, 0.2, 0.4, -0.3, 0.6)
    values = np.concatenate(((3.0, 1.0, 0.5), ray, (-2.0, 4.0, 1.5), ray[::-1])) + 0.1 * rng.standard_normal(18)
    points = tuple(MapPoint(str(i), ray, None, 0.0) for i, ray in enumerate((False, True, False, True)))
    robot = RobotState(rng.standard_normal(3), exp(rng.standard_normal(3)), *rng.standard_normal((2, 3)))
    return SlamState(robot, constants, np.zeros((ROBOT + len(constants) + 18,) * 2), points, values)


def moved(s, turn, shift, growth):
    """The same state in a world that is turned, shifted and enlarged."""
    rotation, scale = exp(turn), 1.0 + growth
    robot = RobotState(
        scale * rotation @ s.robot.position + shift,
        rotation @ s.robot.rotation,
        scale * rotation @ s.robot.velocity,
        s.robot.rate,
    )
    values = s.values.copy()
    for point, start in zip(s.points, s.starts().tolist(), strict=True):
        values[start : start + 3] = scale * rotation @ values[start : start + 3] + shift
        if point.ray:
            (ahead,), _ = inverse_depth.directions(s.values[None, start : start + 6])
            x, y, z = rotation @ ahead
            values[start + 3 : start + 6] = np.arctan2(y, x), np.arcsin(z), s.values[start + 5] / scale
    constants = s.constants.copy()
    if len(constants):
        constants[1] = scale * (1.0 + constants[1]) - 1.0
    return replace(s, robot=robot, values=values, constants=constants)


def direction(s, change):
    """The error (12 + P + D,) of a small ``change`` (7,) of the world, per unit."""
    ahead = moved(s, STEP * change[:3], STEP * change[3:6], STEP * change[6])
    back = moved(s, -STEP * change[:3], -STEP * change[3:6], -STEP * change[6])
    return np.concatenate(
        (ahead.robot.minus(back.robot), ahead.constants - back.constants, ahead.values - back.values)
    ) / (2 * STEP)


@pytest.mark.parametrize("scaled", [True, False])
def test_a_common_change_of_the_world_stays_one_when_the_estimate_moves(scaled):
    rng = np.random.default_rng(3)
    before = state(rng, np.array((0.05, 0.1)) if scaled else np.zeros(0))
    after = before.plus(0.2 * rng.standard_normal(len(before.covariance)), before.covariance)
    for change in rng.standard_normal((5, 7)):
        if not scaled:
            change[6] = 0.0
        was, now = direction(before, change), direction(after, change)
        found = carried(before, replace(after, covariance=np.outer(was, was)), 1 if scaled else None)
        np.testing.assert_allclose(found, np.outer(now, now), rtol=1e-5, atol=1e-4)


def test_an_update_that_moves_nothing_changes_nothing():
    rng = np.random.default_rng(4)
    before = state(rng, np.zeros(CONSTANTS))
    root = rng.standard_normal(before.covariance.shape)
    np.testing.assert_allclose(carried(before, replace(before, covariance=root @ root.T), 1), root @ root.T, atol=1e-9)


COMMON, NEW = 6.0, 20.0  # px: what the heading moves all pixels by, and the depth of a new point its own


def image(seed, *, new=0, count=16):
    """Innovations (K, 2), their covariance and noise; the last ``new`` points are hardly known."""
    rng = np.random.default_rng(seed)
    own = np.full(count, 0.5)
    own[count - new :] = NEW
    noise = np.broadcast_to(np.eye(2), (count, 2, 2))
    u = np.tile((1.0, 0.0), count)
    covariance = COMMON**2 * np.outer(u, u) + np.diag(np.repeat(own, 2) ** 2)
    residual = rng.multivariate_normal(np.zeros(2 * count), covariance + np.eye(2 * count)).reshape(count, 2)
    nothing = np.empty(0, dtype=np.int64)
    return residual, Innovation(np.empty((0, 2 * count)), np.empty((2 * count, 0)), nothing, covariance), noise


@pytest.mark.parametrize("off", [(12.0, 0.0), (-12.0, 3.0)])
def test_new_points_do_not_confirm_wrong_matches(off):
    for seed in range(50):
        residual, innovation, noise = image(seed, new=2)
        residual[:3] = residual[5] + off  # within the gate of each alone
        right = agreeing(residual, innovation, noise)
        assert not right[:3].any()
        assert np.count_nonzero(right) >= 11


def test_one_wrong_match_among_many_good_ones_is_seen():
    for seed in range(50):
        residual, innovation, noise = image(seed)
        residual[0] = residual[1:].mean(axis=0)
        residual[0, 1] += 5.0
        assert not agreeing(residual, innovation, noise)[0]


@pytest.mark.parametrize("new", [0, 2])
def test_right_matches_are_kept(new):
    """One in a hundred is outside of a gate of 99 %; with 1600 of them the share is below 2 % in 9999 of 10000 tests."""
    lost = [np.count_nonzero(~agreeing(*image(seed, new=new))) for seed in range(100)]
    assert sum(lost) < 0.02 * 1600


RATE, TOLD = 0.2, 0.001  # s from image to image; rad, how well each tells the tilt
LEAN = np.array((0.02, -0.01))  # rad, of all points


def learnt(sigma, seed, lean, count=200):
    """What is believed of a floor that is level to ``sigma`` [rad] after ``count`` images of points that ``lean`` (2,)."""
    rng = np.random.default_rng(seed)
    keep = np.exp(-RATE / UNEVEN)
    tilt = sigma * rng.standard_normal(2)
    robot = RobotState(np.zeros(3), exp(np.array((*lean, 0.0))), np.zeros(3), np.zeros(3))
    state = SlamState(robot, np.zeros(0), 1e-9 * np.eye(ROBOT), floor=TiltScale.guessed(0.005))
    for k in range(count):
        tilt = keep * tilt + np.sqrt(1.0 - keep**2) * sigma * rng.standard_normal(2)
        before = state.moved(on_the_floor(standstill(state.robot), RATE, 0.005, state.floor.sigma, UNEVEN))
        gain = before.covariance[:, :2] @ np.linalg.inv(before.covariance[:2, :2] + TOLD**2 * np.eye(2))
        off = tilt + lean + TOLD * rng.standard_normal(2) - tilt_of(before.robot)
        after = before.plus(gain @ off, before.covariance - gain @ before.covariance[:2])
        after = with_floor(before, after, k * RATE)
        state = replace(after, image_odometry=ChainState(k * RATE, *np.zeros(7)))
    return state.floor.sigma


@pytest.mark.parametrize(("sigma", "lean"), [(0.001, 0.0 * LEAN), (0.005, LEAN), (0.015, LEAN)])
def test_the_scale_of_the_tilt_is_found(sigma, lean):
    found = [learnt(sigma, seed, lean) for seed in range(8)]
    assert np.exp(np.mean(np.log(found))) == pytest.approx(sigma, rel=0.3)

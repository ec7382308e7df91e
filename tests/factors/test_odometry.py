"""The motion model: integration, late rows, noise that does not depend on how a path is cut, Jacobians."""

import itertools

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numerical import by_each, derivative

from factors import se2
from factors.graph import pose_array
from factors.motion import Increment
from factors.odometry.chain import OdometryChain
from factors.odometry.factor import OdometryFactor, ScaleFreeOdometryFactor
from factors.odometry.kernels import recalibrate
from factors.odometry.model import (
    LEAST_HEADING,
    LEAST_POSITION,
    MINIMUM_HEADING_VARIANCE,
    MINIMUM_POSITION_VARIANCE,
    Growth,
    OdometryModel,
)

NOISY = OdometryModel(
    along=Growth(0.1, 0.02, 0.01), lateral=Growth(0.03, 0.01, 0.0), heading=Growth(0.05, 0.1, 0.002), direction=0.1
)
NOISY_IN_TIME = OdometryModel(along=Growth(per_time=0.1), lateral=Growth(per_time=0.1), heading=Growth(per_time=0.2))


def velocities(model, rows, **options):
    chain = OdometryChain(model, **options)
    for row in rows:
        chain.add_velocity(*row)
    return chain


def pose_of(state):
    return np.array((state.x, state.y, state.heading))


@pytest.mark.parametrize("increments", [False, True])
def test_scales_and_biases_correct_the_report(increments):
    model = OdometryModel(scale_distance=2.0, scale_rotation=0.5, speed_bias=-0.1, heading_rate_bias=0.2)
    chain = OdometryChain(model)
    if increments:
        chain.add_increment(0.0, 0.0, 0.0, 0.0)
        chain.add_increment(1.0, *se2.exp(np.array((0.4, 0.0, 1.2))))
    else:
        chain.add_velocity(0.0, 0.4, 1.2)
    np.testing.assert_allclose(pose_of(chain.state(1.0)), se2.exp(np.array((1.0, 0.0, 0.5))), atol=1e-12)


@pytest.mark.parametrize("at_once", [False, True])
def test_increments_of_one_stamp_are_one_motion(at_once):
    t = np.array((0.0, 0.0, 1.0, 1.0, 1.0, 2.0))
    moves = np.array(
        ((9.0, 0.0, 0.0), (9.0, 0.0, 0.0), (1.0, 0.0, 0.5), (0.5, 0.2, 0.0), (0.0, 0.0, -0.2), (1.0, 0.0, 0.0))
    )
    model = OdometryModel(along=Growth(per_distance=0.1), heading=Growth(per_rotation=0.1))
    chain, plain = OdometryChain(model), OdometryChain(model)
    if at_once:
        chain.add_increments(t, *moves.T)
    else:
        for stamp, move in zip(t.tolist(), moves.tolist(), strict=True):
            assert chain.add_increment(stamp, *move)
    whole = se2.compose(se2.compose(moves[2], moves[3]), moves[4])
    for stamp, move in ((0.0, np.zeros(3)), (1.0, whole), (2.0, moves[5])):
        plain.add_increment(stamp, *move)
    for start, end in ((0.0, 1.0), (0.3, 0.8), (0.0, 2.0)):
        found, expected = (c.relative(c.state(start), c.state(end)) for c in (chain, plain))
        np.testing.assert_allclose(found.delta, expected.delta, atol=1e-12)
        np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-15)


@pytest.mark.parametrize("use_gyro", [False, True])
def test_the_motion_of_an_increment_may_be_unknown(use_gyro):
    """For a part of its time, which two increments of one stamp add up, or for all of it."""
    t = np.array((0.0, 0.2, 0.4, 0.4, 0.6))
    unknown = np.array((0.0, 0.0, 0.05, 0.1, 9.0))
    chain, other = (OdometryChain(OdometryModel(), use_gyro=use_gyro) for _ in range(2))
    for i in range(5):
        if use_gyro and i not in (0, 3):
            assert chain.add_yaw_rate(t[i] - 0.1, 0.0)
        assert chain.add_increment(t[i], 0.1, 0.0, 0.0, unknown[i])
    other.add_increments(t, *np.full((3, 5), 0.1), unknown)
    for each in (chain, other):
        np.testing.assert_allclose(
            [each.state(s).unknown for s in (0.0, 0.2, 0.4, 0.6)], (0.0, 0.0, 0.15, 0.35), atol=1e-12
        )
    sure, unsure = (chain.relative(chain.state(s), chain.state(s + 0.2)).covariance[0, 0] for s in (0.0, 0.4))
    assert unsure > sure + 0.2 * OdometryModel().unknown_distance ** 2


def test_delay_and_lag_follow_the_step_response():
    delay, lag = 0.1, 0.2
    chain = velocities(OdometryModel(delay=delay, lag=lag), [(0.0, 0.0, 0.0), (1.0, 1.0, 0.0)])
    t = 1.8
    expected = (t - 1.0 - delay) - lag * (1.0 - np.exp(-(t - 1.0 - delay) / lag))
    assert chain.state(t).x == pytest.approx(expected, abs=1e-12)


def test_beyond_the_hold_the_motion_is_unknown():
    chain = velocities(OdometryModel(max_hold=1.0, unknown_distance=0.3), [(0.0, 1.0, 0.0)])
    start, end = chain.state(0.0), chain.state(61.0)
    assert end.x == pytest.approx(1.0)
    assert end.unknown - start.unknown == pytest.approx(60.0)
    variance = chain.relative(start, end).covariance[0, 0]
    assert variance == pytest.approx(0.3**2 * 60.0, rel=1e-3)


@given(st.permutations(range(6)))
def test_late_rows_give_what_rows_in_order_give(order):
    rows = [(0.1 * i, 0.5 + 0.1 * i, 0.3 - 0.2 * i) for i in range(6)]
    model = OdometryModel(lag=0.15, delay=0.05)
    shuffled, ordered = velocities(model, [rows[i] for i in order]), velocities(model, rows)
    np.testing.assert_allclose(pose_of(shuffled.state(0.8)), pose_of(ordered.state(0.8)), atol=1e-12)


def test_what_later_rows_correct_is_in_the_next_increment():
    chain = OdometryChain(OdometryModel())
    chain.add_increment(0.0, 0.0, 0.0, 0.0)
    chain.add_increment(0.1, 0.1, 0.0, 0.0)
    ahead = chain.state(0.15)  # by holding 1 m/s
    chain.add_increment(0.2, 0.3, 0.0, 0.0)  # but it was 3 m/s
    assert ahead.x == pytest.approx(0.15)
    assert chain.relative(ahead, chain.state(0.2)).delta[0] == pytest.approx(0.25)


@pytest.mark.parametrize("late", [False, True])
def test_rows_at_once_are_those_one_by_one(late):
    rows = np.random.default_rng(0).uniform(0.1, 1.0, (60, 3))
    rows[:, 0] = np.cumsum(0.1 * rows[:, 0])
    if late:
        rows = np.concatenate((rows[:20], rows[40:], rows[20:40]))
    one, other = (OdometryChain(OdometryModel(lag=0.1, delay=0.05), horizon=1.0) for _ in range(2))
    for i in range(0, 60, 20):
        kept = sum(one.add_velocity(*row) for row in rows[i : i + 20].tolist())
        assert other.add_velocities(*np.ascontiguousarray(rows[i : i + 20].T)) == kept
        t = float(rows[: i + 20, 0].max())
        assert one.state(t) == other.state(t)
    assert other.add_velocities(*np.empty((3, 0))) == 0


def test_old_rows_are_forgotten_and_recent_ones_kept():
    chain = velocities(OdometryModel(), [(0.01 * i, 1.0, 0.0) for i in range(5000)], horizon=5.0)
    assert not chain.add_velocity(30.0, 1.0, 0.0)
    assert chain.add_velocity(45.5, 1.0, 0.0)
    assert chain.state(49.0).x == pytest.approx(49.0)


def test_gyro_replaces_the_rotation_of_the_wheels():
    chain = OdometryChain(OdometryModel(gyro_bias=0.1), use_gyro=True)
    chain.add_velocity(0.0, 1.0, 9.0)
    chain.add_yaw_rate(0.0, 0.6)
    np.testing.assert_allclose(pose_of(chain.state(1.0)), se2.exp(np.array((1.0, 0.0, 0.5))), atol=1e-12)


def increments_and_gyro(move, rate, turn, *, bias=0.0, seconds=4.0):
    """A chain that was told of increments ``move`` each 0.2 s, and in between, each 0.03 s, of a gyro's ``turn(t)``."""
    chain = OdometryChain(OdometryModel(gyro_bias=bias), use_gyro=True, horizon=100.0)
    rows = [(t, 0, None) for t in np.arange(0.0, seconds + 0.1, 0.2)]
    rows += [(t, 1, turn(t)) for t in np.arange(0.0, seconds, rate)] if rate else []
    for t, _, w in sorted(rows, key=lambda row: row[:2]):
        if w is None:
            assert chain.add_increment(t, *move)
        else:
            assert chain.add_yaw_rate(t, w)
    return chain


def test_a_gyro_replaces_the_rotation_of_increments():
    """The wheels say straight on, the gyro a circle: also between increments, which come after the gyro's rows."""
    chain = increments_and_gyro((0.1, 0.0, 0.0), 0.05, lambda _: 0.6, bias=0.1)
    np.testing.assert_allclose(pose_of(chain.state(4.0)), se2.exp(np.array((2.0, 0.0, 2.0))), atol=1e-9)
    np.testing.assert_allclose(pose_of(chain.state(1.13)), se2.exp(1.13 * np.array((0.5, 0.0, 0.5))), atol=1e-9)
    assert chain.state(4.0).path == pytest.approx(2.0)
    assert chain.state(4.0).unknown == 0.0


def test_increments_under_a_turn_rate_that_varies():
    chain = increments_and_gyro(se2.exp(np.array((0.1, 0.0, -0.3))), 0.01, np.sin, seconds=6.0)
    t = np.arange(0.0, 6.0, 0.001) + 0.0005
    heading = 1.0 - np.cos(t)
    expected = (np.sum(0.0005 * np.cos(heading)), np.sum(0.0005 * np.sin(heading)), 1.0 - np.cos(6.0))
    np.testing.assert_allclose(pose_of(chain.state(6.0)), expected, atol=0.02)  # the gyro's rows are held for 0.01 s


def test_a_gyro_that_is_silent_leaves_the_rotation_to_the_wheels():
    silent = increments_and_gyro((0.1, 0.0, 0.1), 0.0, None)
    way = se2.exp(20.0 * se2.log(np.array((0.1, 0.0, 0.1))))
    np.testing.assert_allclose(pose_of(silent.state(4.0)), way, atol=1e-9)
    chain = OdometryChain(OdometryModel(), use_gyro=True)
    chain.add_velocity(0.0, 1.0, 0.5)
    assert chain.state(1.0).heading == pytest.approx(0.5)


def test_a_gyro_turns_no_robot_whose_increments_say_that_it_stands():
    chain = increments_and_gyro((0.0, 0.0, 0.0), 0.03, lambda t: 0.01 if t < 2.0 else 0.3)
    assert chain.relative(chain.state(0.0), chain.state(1.9)).delta[2] == 0.0
    assert chain.relative(chain.state(0.0), chain.state(1.9)).still == pytest.approx(1.9)
    assert chain.relative(chain.state(2.4), chain.state(3.4)).delta[2] == pytest.approx(0.3)


def test_increments_of_one_stamp_are_one_motion_whatever_a_gyro_told_in_between():
    chain = OdometryChain(OdometryModel(), use_gyro=True)
    for t in (0.0, 0.1, 0.2):
        for _ in range(2):
            chain.add_increment(t, 0.1, 0.0, 0.0)
            chain.add_yaw_rate(t, 0.0)
    assert pose_of(chain.state(0.2)) == pytest.approx((0.4, 0.0, 0.0))


def test_late_rows_of_a_gyro_beside_increments():
    """Whenever they come, the path is the same."""
    rng = np.random.default_rng(0)
    rows = [(0.2 * i, 0, (0.1, 0.01, 0.02)) for i in range(20)] + [(0.07 * i + 0.003, 1, 0.1 * i) for i in range(50)]
    in_order = sorted(rows, key=lambda row: row[0])
    shuffled = sorted(rows, key=lambda row: row[0] + (rng.uniform(0.0, 0.3) if row[1] else 0.0))
    chains = []
    for order in (in_order, shuffled):
        chain = OdometryChain(OdometryModel(), use_gyro=True)
        for t, kind, value in order:
            assert chain.add_yaw_rate(t, value) if kind else chain.add_increment(t, *value)
        chains.append(chain.states(np.arange(0.0, 3.8, 0.1)))
    np.testing.assert_allclose(chains[0], chains[1], atol=1e-9)


def test_at_rest_the_pose_diffuses_by_the_least_noise_alone():
    chain = velocities(NOISY_IN_TIME, [(0.0, 0.5, 0.1), (1.0, 0.0, 0.0), (61.0, 0.5, 0.0)], horizon=100.0)
    rest = chain.relative(chain.state(1.0), chain.state(2.5))  # the hold of a velocity ends then
    np.testing.assert_allclose(rest.delta, 0.0, atol=1e-12)
    assert rest.still == pytest.approx(1.5)
    least = np.array((LEAST_POSITION, LEAST_POSITION, LEAST_HEADING)) ** 2
    instant = MINIMUM_POSITION_VARIANCE, MINIMUM_POSITION_VARIANCE, MINIMUM_HEADING_VARIANCE
    np.testing.assert_allclose(np.diag(rest.covariance), 1.5 * least + instant, rtol=1e-9)
    driven = chain.relative(chain.state(0.0), chain.state(1.0))
    assert driven.still == 0.0
    assert driven.covariance[2, 2] > 0.1**2


def test_increments_of_nothing_are_a_rest_and_others_none():
    chain = OdometryChain(NOISY_IN_TIME)
    for i in range(10):
        chain.add_increment(0.1 * i, 0.05 if i > 5 else 0.0, 0.0, 0.0)
    assert chain.relative(chain.state(0.0), chain.state(0.5)).still == pytest.approx(0.5)
    assert chain.relative(chain.state(0.5), chain.state(0.9)).still == 0.0


def test_what_is_reported_at_rest_is_a_rest():
    model = OdometryModel(speed_bias=-0.02, heading_rate_bias=0.003)
    chain = velocities(model, [(0.0, -0.02, 0.003), (1.0, 0.0, 0.003)])
    assert chain.relative(chain.state(0.0), chain.state(1.0)).still == pytest.approx(1.0)
    assert chain.relative(chain.state(1.0), chain.state(2.0)).still == 0.0


def test_a_robot_that_runs_out_after_a_command_to_stop_is_not_yet_at_rest():
    chain = velocities(OdometryModel(lag=0.2), [(0.1 * i, 0.5 if i < 10 else 0.0, 0.0) for i in range(40)])
    assert chain.relative(chain.state(1.0), chain.state(1.5)).still == 0.0
    assert chain.relative(chain.state(3.0), chain.state(3.5)).still == pytest.approx(0.5)


def test_a_gyro_turns_no_robot_at_rest_unless_it_tells_more_than_its_noise():
    chain = OdometryChain(OdometryModel(), use_gyro=True)
    for i in range(40):
        chain.add_velocity(0.1 * i, 0.0, 0.0)
        chain.add_yaw_rate(0.1 * i + 0.01, 0.01 if i < 20 else 0.3)
    rest = chain.relative(chain.state(0.0), chain.state(1.9))
    assert rest.delta[2] == 0.0
    assert rest.still == pytest.approx(1.9)
    turn = chain.relative(chain.state(2.05), chain.state(3.05))  # in place, though the wheels do not say so
    assert turn.delta[2] == pytest.approx(0.3)
    assert turn.still == 0.0


def test_a_rate_bias_does_not_turn_a_robot_at_rest():
    chain = velocities(OdometryModel(), [(0.0, 0.5, 0.0), (1.0, 0.0, 0.0)])
    whole = chain.relative(chain.state(0.0), chain.state(2.0))
    delta, _ = recalibrate(se2.log(whole.delta), whole.moving, np.array((0.0, 0.0, 0.1, 0.0)))
    assert delta[2] == pytest.approx(-0.1)


@given(st.integers(1, 40), st.floats(0.05, 1.0), st.floats(-0.6, 0.6))
def test_noise_does_not_depend_on_how_a_path_is_cut(pieces, speed, turn_rate):
    chain = velocities(NOISY, [(0.0, speed, turn_rate)])
    times = np.linspace(0.0, 1.0, pieces + 1)
    covariance = np.zeros((3, 3))
    for start, end in itertools.pairwise(times):
        step = chain.relative(chain.state(start), chain.state(end))
        carried = se2.adjoint(se2.inverse(step.delta))
        covariance = carried @ covariance @ carried.T + step.covariance
    whole = chain.relative(chain.state(0.0), chain.state(1.0)).covariance
    # the model of the whole takes the noise as spread evenly over the chord: good to a few percent over a metre
    np.testing.assert_allclose(covariance, whole, atol=0.05 * np.abs(whole).max())


increments = st.tuples(st.floats(-0.5, 1.0), st.floats(-0.2, 0.2), st.floats(-0.8, 0.8)).map(np.array)


def random_covariance(seed):
    root = np.random.default_rng(seed).normal(size=(3, 3)) * 0.1 + 0.2 * np.eye(3)
    return root @ root.T


@given(increments, st.tuples(*[st.floats(-0.2, 0.2)] * 4).map(np.array))
def test_jacobian_of_the_parameters_is_the_numerical_one(delta, parameters):
    twist = se2.log(delta)
    here, jacobian = recalibrate(twist, 0.7, parameters)
    numerical = derivative(lambda d: se2.log(se2.between(here, recalibrate(twist, 0.7, parameters + d)[0])), 4)
    np.testing.assert_allclose(jacobian, numerical, atol=1e-7)


@pytest.mark.parametrize("kind", [OdometryFactor, ScaleFreeOdometryFactor])
@given(increments, increments, increments, st.integers(0, 1000))
def test_jacobians_of_the_factor_are_the_numerical_ones(kind, delta, start, moved, seed):
    factor = kind(Increment(delta, random_covariance(seed), 0.5), (0, 1, 2))
    values = [start, se2.compose(start, moved), np.array((0.03, -0.04, -0.1))]
    _, blocks = factor.linearize(values)
    numerical = by_each(lambda v: factor.linearize(v)[0], values, (0, 1))
    for block, expected in zip(blocks, numerical, strict=True):
        np.testing.assert_allclose(block, expected, atol=1e-4)


@given(increments, increments, st.floats(-0.3, 0.3), st.integers(0, 1000))
def test_no_scale_is_preferred_where_only_the_wheels_tell_one(delta, moved, change, seed):
    # in a world that is larger by the same factor as what the wheels are corrected by, the wheels are wrong by as much
    factor = ScaleFreeOdometryFactor(Increment(delta, random_covariance(seed), 0.5), (0,))
    larger = moved * (1.0 + change, 1.0 + change, 1.0)
    ends = (moved, 0.0), (larger, change)
    residuals = [factor.linearize([np.zeros(3), end, np.array((constant,))])[0] for end, constant in ends]
    np.testing.assert_allclose(*residuals, rtol=1e-6, atol=1e-6)


@given(increments, increments, increments, st.integers(0, 1000))
def test_the_factor_without_parameters_is_gtsams(delta, start, moved, seed):
    increment = Increment(delta, random_covariance(seed), 0.5)
    values = gtsam.Values()
    values.insert(0, gtsam.Pose2(*start))
    values.insert(1, gtsam.Pose2(*se2.compose(start, moved)))
    ours = OdometryFactor(increment).cost([pose_array(values.atPose2(key)) for key in (0, 1)])
    noise = gtsam.noiseModel.Gaussian.Covariance(increment.covariance)
    theirs = gtsam.BetweenFactorPose2(0, 1, gtsam.Pose2(*increment.delta), noise)
    assert ours == pytest.approx(theirs.error(values), rel=1e-6, abs=1e-9)


def test_a_robot_that_turns_is_slower_than_commanded():
    model = OdometryModel(turn_slowdown=0.1)
    straight, turning, backwards, on_the_spot = (
        velocities(model, [(0.0, v, w)]).state(1.0) for v, w in ((0.2, 0.0), (0.2, -0.5), (-0.2, 0.5), (0.0, 0.5))
    )
    assert straight.path == pytest.approx(0.2)
    assert turning.path == pytest.approx(0.15)
    assert turning.heading == pytest.approx(-0.5)
    assert backwards.path == pytest.approx(0.15)
    assert backwards.x < 0.0
    assert on_the_spot.path == 0.0
    assert on_the_spot.heading == pytest.approx(0.5)

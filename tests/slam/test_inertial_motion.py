"""An inertial unit: closed forms, derivatives and noise of its motion, and estimators that use it, on made-up runs."""

from dataclasses import replace

import numpy as np
import pytest
import short_logs
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from space_world import RIG_INERTIAL, swayed

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation import space
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.measurement import selected
from factorgraph_loc.sensors.inertial.settings import InertialSettings
from factorgraph_loc.slam.inertial_motion import BIASES, MOVING, InertialChain, InertialMotion
from factorgraph_loc.slam.space_motion import RATE, ROBOT, RobotState
from factorgraph_loc.slam.space_motion_models import KnownState

SENSORS = ("inertial", "sightings")
UNIT = InertialSettings(
    x=0.2,
    y=-0.1,
    z=0.05,
    roll=0.3,
    pitch=-0.2,
    yaw=1.0,
    force_noise=0.02,
    turn_noise=0.003,
    force_walk=0.01,
    turn_walk=0.001,
)
TURN = Rotation.from_euler("ZYX", (UNIT.yaw, UNIT.pitch, UNIT.roll))
STILL = RobotState(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
UP = np.array((0.0, 0.0, UNIT.gravity))


def rows_of(t, force, turn, arm=(UNIT.x, UNIT.y, UNIT.z)):
    """Rows (N, 6) at ``t`` (N,) of a force (N, 3) at the robot's origin and a turn rate (N, 3), both along the robot's axes."""
    felt = np.cross(np.gradient(turn, t, axis=0), arm) + np.cross(turn, np.cross(turn, arm))
    return np.hstack((TURN.inv().apply(force + felt), TURN.inv().apply(turn)))


def motion_from(t, rows, unit=UNIT):
    chain = InertialChain(unit)
    for stamp, row in zip(t.tolist(), rows, strict=True):
        assert chain.add(stamp, row)
    return InertialMotion(chain, unit)


def motion_of(t, force, turn):
    """The motion of such rows."""
    return motion_from(t, rows_of(t, force, turn))


def known(robot, t=0.0, covariance=None):
    return KnownState(t, robot, np.eye(ROBOT + 6) if covariance is None else covariance, np.zeros(6))


def test_a_unit_at_rest_stays_where_it_is():
    t = np.arange(101) * 0.01
    robot = motion_of(t, np.tile(UP, (101, 1)), np.zeros((101, 3))).step(known(STILL), 1.0).robot
    np.testing.assert_allclose(robot.position, 0.0, atol=1e-12)
    np.testing.assert_allclose(robot.velocity, 0.0, atol=1e-12)


def test_a_constant_acceleration_is_integrated():
    """Also between rows, and along the axes of a robot that is tilted."""
    t, pushed = np.arange(101) * 0.01, np.array((0.5, -0.2, 0.3))
    tilted = Rotation.from_euler("ZYX", (0.4, 0.3, -0.2))
    start = RobotState(np.array((1.0, 2.0, 3.0)), tilted.as_matrix(), np.array((0.1, 0.2, -0.3)), np.zeros(3))
    force = np.tile(tilted.inv().apply(pushed + UP), (101, 1))
    robot = motion_of(t, force, np.zeros((101, 3))).step(known(start, 0.203), 0.907).robot
    dt = 0.704
    np.testing.assert_allclose(robot.velocity, start.velocity + dt * pushed, atol=1e-9)
    np.testing.assert_allclose(robot.position, start.position + dt * start.velocity + 0.5 * dt**2 * pushed, atol=1e-9)


def test_a_robot_that_turns_faster_and_faster_on_the_spot_does_not_move():
    """What the unit feels 23 cm away is taken off; the angle is that of a constant angular acceleration."""
    t = np.arange(201) * 0.005
    turn = np.column_stack((np.zeros(201), np.zeros(201), 0.5 + 2.0 * t))
    robot = motion_of(t, np.tile(UP, (201, 1)), turn).step(known(STILL), 1.0).robot
    np.testing.assert_allclose(robot.rotation, Rotation.from_rotvec((0.0, 0.0, 1.5)).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(robot.position, 0.0, atol=1e-5)
    np.testing.assert_allclose(robot.velocity, 0.0, atol=1e-5)


def test_a_circle_is_driven():
    """Speed 1 m/s on a radius of 2 m, rows of 200 Hz: wrong by less than 0.1 mm after 1 s."""
    t = np.arange(201) * 0.005
    force, turn = UP + np.tile((0.0, 0.5, 0.0), (201, 1)), np.tile((0.0, 0.0, 0.5), (201, 1))
    start = replace(STILL, velocity=np.array((1.0, 0.0, 0.0)))
    robot = motion_of(t, force, turn).step(known(start), 1.0).robot
    np.testing.assert_allclose(robot.position, (2.0 * np.sin(0.5), 2.0 - 2.0 * np.cos(0.5), 0.0), atol=1e-4)
    np.testing.assert_allclose(robot.velocity, (np.cos(0.5), np.sin(0.5), 0.0), atol=1e-4)


def moving(rng, count=41):
    """Rows of 0.4 s, and a robot that moves."""
    t = np.arange(count) * 0.01
    motion = motion_of(t, UP + rng.standard_normal((count, 3)), 0.5 * rng.standard_normal((count, 3)))
    rotation = Rotation.from_rotvec((0.3, -0.4, 1.0)).as_matrix()
    return motion, RobotState(np.array((1.0, 2.0, 0.5)), rotation, np.array((0.5, -0.3, 0.1)), np.zeros(3))


def test_derivatives_of_the_step():
    """Of pose and velocity by these and by the biases, against numerical ones with steps of 1e-6."""
    motion, robot = moving(np.random.default_rng(0))
    step = motion.step(known(robot), 0.4)

    def end(error):
        moved = replace(known(robot.plus(error[:ROBOT])), constants=error[ROBOT:])
        return motion.step(moved, 0.4).robot.minus(step.robot)

    numerical = approx_fprime(np.zeros(ROBOT + 6), end, 1e-6)
    numerical[RATE], numerical[:, RATE] = 0.0, 0.0
    np.testing.assert_allclose(step.transition, numerical, atol=2e-5)


def test_noise_of_the_step():
    """Of 1,000 drawn runs of a unit at the robot's origin: standard deviations within 10 % of those of the step, which fails right
    ones once in 10,000 times. Elsewhere the noise of turn rates is in the velocity at both ends of a step, and cancels in the next.
    """
    rng, unit = np.random.default_rng(1), UNIT.model_copy(update=dict.fromkeys("xyz", 0.0))
    t, ends = np.arange(41) * 0.01, []
    rows = rows_of(t, np.tile(UP, (41, 1)), np.tile((0.1, -0.2, 0.3), (41, 1)), np.zeros(3))
    sigma = np.repeat((UNIT.force_noise, UNIT.turn_noise), 3) / np.sqrt(0.01)
    step = motion_from(t, rows, unit).step(known(STILL), 0.4)
    for _ in range(1000):
        drawn = motion_from(t, rows + sigma * rng.standard_normal(rows.shape), unit)
        ends.append(drawn.step(known(STILL), 0.4).robot.minus(step.robot)[:9])
    sigmas = np.sqrt(np.diag(step.noise))[:9]
    np.testing.assert_allclose(np.std(ends, axis=0), sigmas, rtol=0.1)
    np.testing.assert_allclose(step.drift, 0.4 * np.repeat((UNIT.force_walk, UNIT.turn_walk), 3) ** 2)


def test_the_prior_and_the_factors_of_a_graph_are_those_of_the_filter():
    """From a known state the joint of the next one is what the filter predicts, with all correlations."""
    rng = np.random.default_rng(2)
    motion, robot = moving(rng)
    root = 0.05 * rng.standard_normal((ROBOT + 6, ROBOT + 6))
    start = known(robot, covariance=root @ root.T + 1e-4 * np.eye(ROBOT + 6))
    predicted = start.moved(motion.step(start, 0.4), 0.4)
    values = motion.values(0, start)
    values.insert(motion.values(1, predicted))
    graph = [motion.prior(0, start), *motion.factors((0, 1), (0.0, 0.4), start)]
    order = [*motion.joint((0,)), *motion.joint((1,))]
    information, columns = np.zeros((30, 30)), {}
    for key, size in (motion.sizes(0) | motion.sizes(1)).items():
        columns[key] = np.arange(size) + sum(map(len, columns.values()))
    assert sorted(order) == sorted(columns)
    for factor in graph:
        assert factor.error(values) == pytest.approx(0.0, abs=1e-9)
        jacobian, _ = factor.linearize(values).jacobian()
        where = np.concatenate([columns[key] for key in factor.keys()])  # noqa: SIM118
        information[np.ix_(where, where)] += jacobian.T @ jacobian
    found = np.linalg.inv(information)[15:, 15:]
    right = predicted.covariance[np.ix_(MOVING, MOVING)]
    sigmas = np.sqrt(np.diag(right))
    np.testing.assert_allclose(found / np.outer(sigmas, sigmas), right / np.outer(sigmas, sigmas), atol=1e-5)


def estimated(log, name, sensors=SENSORS, **settings):
    return run(log, RunConfig(name, settings, sensors))


def nees(found, log, row=-1):
    errors = space.pose_errors(found, log.reference3.at(found.t))
    return float(errors[row] @ np.linalg.solve(found.covariances[row], errors[row]))


@pytest.mark.parametrize("name", ["monoslam", "space_smoother"])
def test_an_inertial_unit_helps_and_the_covariances_are_those_of_the_errors(name):
    """NEES of 8 runs, causal at their end and final in their middle, within bounds that fail right covariances with 0.1 % each; and
    errors of three runs are half of those without, or less."""
    causal, final, errors, blind = [], [], [], []
    for seed in range(8):
        log = swayed(seed)
        result = estimated(log, name)
        causal.append(nees(result.causal_space, log))
        final.append(nees(result.final_space, log, len(result.final_space) // 2))
        errors.append(score(result, log)["final.space_position_rmse"])
        if seed < 3:
            blind.append(score(estimated(log, name, ("sightings",)), log)["final.space_position_rmse"])
    low, high = chi2.ppf((5e-4, 1.0 - 5e-4), 6 * 8)
    assert low < sum(causal) < high
    assert low < sum(final) < high
    assert np.mean(errors[:3]) < 0.5 * np.mean(blind)


def test_biases_are_learnt():
    """Those of turn rates, to a tenth of what was known of them; their names are those of the result."""
    found = estimated(swayed(1), "monoslam").learnt.values
    assert tuple(found) == BIASES
    for name in BIASES[3:]:
        assert found[name][1] < 0.1 * RIG_INERTIAL.inertial.turn_bias


def test_the_batch_and_the_window_are_where_the_filter_is():
    """All are estimates of one problem that is nearly linear."""
    log = swayed(3)
    filtered, window, batch = (estimated(log, name) for name in ("monoslam", "space_smoother", "space_batch"))
    for ours, theirs in (
        (window.causal_space, filtered.causal_space),
        (batch.final_space, filtered.final_space),
    ):
        sigmas = np.sqrt(np.array([np.diag(c) for c in theirs.covariances]))
        assert np.quantile(np.abs(space.pose_errors(ours, theirs)) / sigmas, 0.95) < 0.3
        ratio = np.array([np.diag(c) for c in ours.covariances]) / sigmas**2
        assert np.median(ratio) == pytest.approx(1.0, abs=0.05)
    np.testing.assert_array_equal(window.final_space.positions, batch.final_space.positions)


def test_a_late_image_counts_once():
    """When all have come, what is known is what it would be without delay, but for the robust weights of before."""
    sensors = (*SENSORS, "sightings_right")
    whole = swayed(3)
    late = short_logs.late(whole, "sightings_right")
    ours, theirs = (estimated(log, "space_smoother", sensors).causal_space for log in (late, whole))
    sigmas = np.sqrt(np.diag(theirs.covariances[-1]))
    np.testing.assert_array_less(np.abs(space.pose_errors(ours, theirs)[-1]) / sigmas, 0.4)


def test_a_precise_unit_while_little_is_seen():
    """As good as a data sheet says of one at rest, with two points in the first two seconds: what the window solves then is nearly
    singular. NEES of 8 runs within bounds as above."""
    noise = {"force_noise": 2e-3, "turn_noise": 1.7e-4, "force_walk": 3e-3, "turn_walk": 1.9e-5}
    causal, final = [], []
    for seed in range(8):
        log = swayed(seed, **noise)
        seen = log.streams["sightings"]
        kept = selected(seen, np.array([name in {"p0", "p1"} for name in seen.point]) | (seen.t > 2.0))
        result = estimated(replace(log, streams=dict(log.streams) | {"sightings": kept}), "space_smoother")
        causal.append(nees(result.causal_space, log))
        final.append(nees(result.final_space, log, len(result.final_space) // 2))
    low, high = chi2.ppf((5e-4, 1.0 - 5e-4), 6 * 8)
    assert low < sum(causal) < high
    assert low < sum(final) < high


def test_a_second_without_rows():
    """NEES of 8 runs in the middle of the pause, of the final trajectory, and at the end: within bounds as above."""
    causal, final = [], []
    for seed in range(8):
        log = swayed(seed)
        rows = log.streams["inertial"]
        kept = selected(rows, (rows.t < 3.0) | (rows.t > 4.0))
        result = estimated(replace(log, streams=dict(log.streams) | {"inertial": kept}), "space_smoother")
        causal.append(nees(result.causal_space, log))
        at = int(np.argmin(np.abs(result.final_space.t - 3.5)))
        final.append(nees(result.final_space, log, at))
    low, high = chi2.ppf((5e-4, 1.0 - 5e-4), 6 * 8)
    assert low < sum(causal) < high
    assert low < sum(final) < high


def test_without_a_map_one_eye_does_not_use_it_and_two_eyes_do():
    """One eye cannot know the scale and says so. NEES of two eyes over 8 runs: below what a right one exceeds once in 10,000. In
    four of them the errors are half of those without, or less."""
    alone = run(swayed(0), RunConfig("monoslam", {"landmarks": "unknown"}, SENSORS))
    assert any("scale is unknown" in text for _, text in alone.diagnostics.events)
    assert alone.diagnostics.ignored["inertial unit"] == len(swayed(0).streams["inertial"].t)
    found, errors, blind = [], [], []
    for seed in range(8):
        log = swayed(seed)
        for sensors in ((*SENSORS, "sightings_right"), ("sightings", "sightings_right"))[: 2 if seed < 4 else 1]:
            result = run(log, RunConfig("monoslam", {"landmarks": "unknown"}, sensors))
            assert not any("scale is unknown" in text for _, text in result.diagnostics.events)
            last = space.pose_errors(result.final_space, log.reference3.at(result.final_space.t))[-1, 3:]
            (errors if "inertial" in sensors else blind).append(np.linalg.norm(last))
            if "inertial" in sensors:
                found.append(nees(result.final_space, log))
    assert sum(found) < chi2.ppf(1.0 - 1e-4, 6 * 8)
    assert np.mean(errors[:4]) < 0.5 * np.mean(blind)


@pytest.mark.parametrize("name", ["ekf", "smoother"])
def test_estimators_in_the_plane_refuse_a_robot_in_space(name):
    with pytest.raises(InputError, match="moves in space"):
        estimated(swayed(0), name)

"""What the solvers make of a robot whose odometry constants are estimated, where nothing but its start ties it to the world."""

import camera_world
import gtsam
import landmark_world
import numpy as np
import pytest
from changed_logs import with_rig, with_stream
from landmark_world import simulate

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.graph import isam
from factorgraph_loc.fusion.graph.graph import Node
from factorgraph_loc.fusion.graph.problem import IndeterminateError, Problem, covariances
from factorgraph_loc.fusion.graph.solver import Window
from factorgraph_loc.fusion.graph.summary import MarginalSummary
from factorgraph_loc.sensors.odometry.settings import OdometryUncertainty
from factors import se2
from factors.graph import constants_key, is_pose, landmark_key, pose_array, pose_key, to_gtsam

START = "0,0,0"  # its standard deviations are 0.05 m, 0.05 m, 0.05 rad
SIGMA = 0.05


def values_of(values, keys):
    """GTSAM's values of variables, as arrays by key."""
    return {key: pose_array(values.atPose2(key)) if is_pose(key) else values.atVector(key) for key in keys}


@pytest.fixture(scope="module")
def log():
    """The wheels report 7 % too little, and turns of 0.04 rad/s that there are not."""
    made = landmark_world.simulate(seed=1, seconds=20.0)
    wheels = made.streams["odometry"]
    wrong = with_stream(made, "odometry", v=wheels.v / 1.08, w=wheels.w + 0.04)
    return with_rig(wrong, "odometry", uncertainty=OdometryUncertainty(scale_distance=0.1, heading_rate_bias=0.05))


def test_nothing_is_learnt_of_a_start_that_nothing_measures(log):
    """The covariance of the first pose stays that of the prior, however often the graph is linearised anew."""
    sigmas = []

    def watch(_, estimator):
        sigmas.append(np.sqrt(np.diag(estimator._backend._solver.covariance(pose_key(0)))))

    run(log, RunConfig("smoother", {"landmarks": "unknown"}, prior=START), watch=watch)
    assert np.allclose(sigmas, SIGMA, rtol=1e-4)


@pytest.mark.parametrize(
    ("world", "lag"), [(camera_world, 1.5), (landmark_world, 6.0), (camera_world, "all"), (landmark_world, "all")]
)
def test_what_comes_and_goes_tells_nothing_of_the_heading_at_the_start(world, lag):
    """The heading is never known better than it was then: not by landmarks that share its error, nor where all has moved and the
    start has left the window."""
    log = world.simulate(seed=1, seconds=30.0)
    result = run(log, RunConfig("smoother", {"landmarks": "unknown", "lag": lag}, prior=START))
    assert np.sqrt(result.covariances[:, 2, 2]).min() > SIGMA * (1.0 - 1e-3)


def test_a_window_that_is_built_anew_counts_nothing_twice(monkeypatch):
    """The failing update has been applied when it raises. The poses that are left are where they were, and known as well."""
    log = camera_world.simulate(1, 20.0)
    config = RunConfig("smoother", {"landmarks": "unknown", "lag": 6.0})
    expected = run(log, config)
    update, calls = Window.update, []

    def failing(self, *arguments):
        update(self, *arguments)
        calls.append(None)
        if len(calls) == 25:
            raise RuntimeError("made to fail")

    monkeypatch.setattr(Window, "update", failing)
    result = run(log, config)
    (event,) = result.diagnostics.events
    assert 10.0 < event.t < 15.0
    assert (event.kind, event.fields) == ("solver_rebuilt", {"why": "made to fail"})
    after = result.t > event.t
    ratio = np.linalg.det(result.covariances[after]) / np.linalg.det(expected.covariances[after])
    assert np.all((ratio > 0.8) & (ratio < 1.25))
    apart = result.poses - expected.poses
    apart[:, 2] = se2.wrap(apart[:, 2])
    squared = [d @ np.linalg.solve(c, d) for d, c in zip(apart[after], expected.covariances[after], strict=True)]
    assert np.max(squared) < 1.0  # the points are linearised at another update


def test_a_window_that_keyframes_leave_is_not_built_anew():
    """Now and then a point is taken in that was seen from a keyframe which leaves with the same update."""
    result = run(camera_world.simulate(1, 20.0), RunConfig("smoother", {"landmarks": "unknown", "lag": 1.5}))
    assert not result.diagnostics.events


def test_covariances_of_poses_at_once_are_those_of_each(log):
    compared = []

    def watch(_, estimator):
        solver = estimator._backend._solver
        if not compared and estimator._graph.newest.index > 40:
            poses = [pose_key(estimator._graph.newest.index - back) for back in (9, 8, 4)]
            at_once = solver.covariances(poses)
            compared.extend(np.allclose(at_once[key], solver.covariance(key), rtol=1e-7) for key in poses)

    run(log, RunConfig("smoother", {"lag": 6.0}, prior=START), watch=watch)
    assert compared == [True, True, True]


def test_what_is_absent_is_marginalised_out_of_a_summary():
    graph, at = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array((0.1, 0.1, 0.02)))
    for i in range(2):
        at.insert(pose_key(i), gtsam.Pose2(float(i), 0.0, 0.1))
    step = gtsam.BetweenFactorPose2(pose_key(0), pose_key(1), gtsam.Pose2(1.0, 0.0, 0.0), noise)
    graph.add(gtsam.PriorFactorPose2(pose_key(0), gtsam.Pose2(0.0, 0.0, 0.0), noise))
    graph.add(gtsam.LinearContainerFactor(step.linearize(at), at))
    (left,) = MarginalSummary.of(graph, at, values_of(at, at.keys())).on({pose_key(1)})
    marginal = gtsam.Marginals(graph, at).marginalCovariance(pose_key(1))
    assert list(left.keys()) == [pose_key(1)]
    assert np.allclose(np.linalg.inv(left.linearize(at).information()), marginal, rtol=1e-6)


class _Seen:
    """A landmark ``ahead`` [m] of the robot, with a standard deviation of 1 cm."""

    def __init__(self, ahead=10.0):
        self._place = np.array((ahead, 0.0))

    def linearize(self, values):
        (x, y, heading), landmark = values
        c, s = np.cos(heading), np.sin(heading)
        back = np.array(((c, s), (-s, c)))
        there = back @ (landmark - (x, y))
        by_pose = np.array(((-1.0, 0.0, there[1]), (0.0, -1.0, -there[0])))
        return 100.0 * (there - self._place), [100.0 * by_pose, 100.0 * back]

    def cost(self, values):
        residual, _ = self.linearize(values)
        return 0.5 * float(residual @ residual)


def test_a_window_that_begins_with_marginal_factors_linearises_what_they_are_on_where_they_do():
    """The robot turns by 0.3 rad, with all that it sees: linearised before and after that, these would seem to tell its heading."""
    pose, landmark, unit = pose_key(0), landmark_key(0), gtsam.noiseModel.Unit.Create(2)
    values = {pose: np.zeros(3), landmark: np.array((10.0, 0.0))}
    start = gtsam.noiseModel.Diagonal.Sigmas(np.array((0.1, 0.1, 0.3)))
    residual, blocks = _Seen().linearize(list(values.values()))
    seen = gtsam.JacobianFactor(pose, blocks[0], landmark, blocks[1], -residual, unit)
    turned = gtsam.PriorFactorPose2(pose, gtsam.Pose2(0.0, 0.0, 0.3), start).linearize(to_gtsam(values))
    window = Window(gtsam.ISAM2Params(), 0.02, [].append, 10.0)
    factors = [gtsam.LinearContainerFactor(factor, to_gtsam(values)) for factor in (turned, seen)]
    node = Node((pose, landmark), _Seen(), 2)
    window.begin(factors, [node], values, {pose: 0.0, landmark: 0.0})
    for t in range(1, 5):
        window.update([node], {}, float(t))
    assert window.value(pose)[2] == pytest.approx(0.3, abs=0.01)
    assert np.sqrt(window.covariance(pose)[2, 2]) == pytest.approx(0.3, rel=1e-4)
    assert set(window._ours.at) == set(values)


class _Bearing:
    """A landmark straight ahead of the robot, with a standard deviation of 0.01 rad."""

    def linearize(self, values):
        pose, landmark = values
        ahead, across = se2.transform_to(pose, landmark)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        by_place = np.array((-across, ahead)) / (ahead**2 + across**2)
        by_landmark = by_place @ np.array(((c, s), (-s, c)))
        residual = np.array((100.0 * np.arctan2(across, ahead),))
        return residual, [100.0 * np.array(((*-by_place, -1.0),)), 100.0 * by_landmark[None]]

    def cost(self, values):
        residual, _ = self.linearize(values)
        return 0.5 * float(residual @ residual)


def test_what_a_window_sees_of_old_landmarks_is_linearised_where_they_are_by_now():
    """The robot and a landmark are moved aside by 0.8 m together, which tells nothing of the heading from which it is seen again.
    With the landmark where it was first, the second heading would be 0.06 rad off. A window that is built anew begins there."""
    first, second, landmark = pose_key(0), pose_key(1), landmark_key(0)
    values = {first: np.zeros(3), landmark: np.array((2.0, 0.0))}
    aside = gtsam.PriorFactorPose2(first, gtsam.Pose2(0.0, 0.8, 0.0), gtsam.noiseModel.Isotropic.Sigma(3, 0.05))
    residual, blocks = _Seen(2.0).linearize(list(values.values()))
    seen = gtsam.JacobianFactor(first, blocks[0], landmark, blocks[1], -residual, gtsam.noiseModel.Unit.Create(2))
    parameters = gtsam.ISAM2Params()
    parameters.relinearizeSkip = 1
    window = Window(parameters, 0.02, [].append, 10.0)
    factors = [
        gtsam.LinearContainerFactor(factor, to_gtsam(values)) for factor in (aside.linearize(to_gtsam(values)), seen)
    ]
    window.begin(factors, [], values, {first: 0.0, landmark: 0.0})
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array((0.01, 0.01, 0.03)))
    ahead = gtsam.BetweenFactorPose2(first, second, gtsam.Pose2(0.5, 0.0, 0.0), noise)
    step = Node((first, second), native=ahead)
    nodes = [step, Node((second, landmark), _Bearing(), 1)]
    window.update(nodes, {second: np.array((0.5, 0.8, 0.0))}, 1.0)
    for t in range(2, 6):
        window.update([], {}, float(t))
    summary = window.summary(failed=False)
    assert np.allclose(summary.at[landmark], (2.0, 0.8), atol=0.03)
    again = Window(parameters, 0.02, [].append, 10.0)
    again.begin(summary.on(summary.at), nodes, summary.at, dict.fromkeys(summary.at, 5.0))
    for one in (window, again):
        assert np.allclose(one.value(second), (0.5, 0.8, 0.0), atol=1e-3)
        assert np.allclose(one.value(landmark), (2.0, 0.8), atol=1e-3)
        assert np.sqrt(one.covariance(first)[2, 2]) == pytest.approx(0.05, rel=1e-3)


STEP = np.array(((1.0, 0.0, 0.03), (0.0, 1.0, 0.3), (0.0, 0.0, 1.0)))
WHITENER = np.diag((300.0, 3000.0, 200.0))
UNIT = gtsam.noiseModel.Unit.Create(3)
GTSAM_SAYS = "\nIndeterminate linear system detected while working near variable\n{} (Symbol: x0).\n\nThrown when"

KEY = constants_key(0)


def chain(count, anchored=True):
    """Dead reckoning of ``count`` steps, and the covariance of its end."""
    graph, spread = gtsam.GaussianFactorGraph(), 1e-4 * np.eye(3)
    if anchored:
        graph.add(gtsam.JacobianFactor(0, 1e2 * np.eye(3), np.zeros(3), UNIT))
    for i in range(count):
        graph.add(gtsam.JacobianFactor(i, -WHITENER @ STEP, i + 1, WHITENER, np.zeros(3), UNIT))
        spread = STEP @ spread @ STEP.T + np.linalg.inv(WHITENER @ WHITENER)
    return graph, spread


@pytest.mark.parametrize("count", [300, 3000])
def test_covariance_of_a_long_chain(count):
    """Cholesky takes the longer one for indeterminate."""
    graph, expected = chain(count)
    found = covariances(graph, dict.fromkeys(range(count + 1), 3), [count])
    assert found.damping == 0.0
    assert np.allclose(found.by_key[count], expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_a_chain_that_hangs_on_nothing_is_damped():
    graph, _ = chain(30, anchored=False)
    found = covariances(graph, dict.fromkeys(range(31), 3), range(31))
    assert 0.0 < found.damping < 1e-6
    for covariance in found.by_key.values():
        assert np.all(np.linalg.eigvalsh(covariance) > 0.0)
        assert covariance[2, 2] > 1.0


def test_a_graph_that_factors_were_removed_from_is_damped():
    """iSAM2 keeps their places, empty."""
    graph, _ = chain(30, anchored=False)
    removed = gtsam.NonlinearFactorGraph()
    removed.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), UNIT))
    removed.remove(0)
    graph.push_back(removed.linearize(gtsam.Values()))
    assert covariances(graph, dict.fromkeys(range(31), 3), [30]).damping > 0.0


def test_what_nothing_tells_of_is_named():
    graph, _ = chain(3)
    graph.add(gtsam.JacobianFactor(4, np.eye(3)[:2], np.zeros(2), gtsam.noiseModel.Unit.Create(2)))
    with pytest.raises(IndeterminateError) as raised:
        covariances(graph, dict.fromkeys(range(5), 3), range(5))
    assert raised.value.key == 4


class Hole:
    """The square of a distance from zero, which is not a number below 1."""

    def linearize(self, values):
        return values[0].copy(), [np.eye(1)]

    def cost(self, values):
        return 0.5 * float(values[0] @ values[0]) if values[0][0] > 1.0 else np.nan


def test_a_cost_that_is_no_number_is_not_lower():
    solution = Problem([(Hole(), (KEY,))]).solve({KEY: np.array([3.0])})
    assert 1.0 < solution.values[KEY][0] <= 3.0
    assert np.isfinite(solution.cost)


def test_a_start_without_a_cost_stays_where_nothing_better_is():
    solution = Problem([(Hole(), (KEY,))]).solve({KEY: np.array([0.5])})
    assert solution.values[KEY][0] == 0.5
    assert solution.cost == np.inf


def test_the_window_survives_marginals_that_fail(monkeypatch):
    brief = simulate(seconds=12.0)
    config = RunConfig("smoother", {"lag": 5.0})
    expected, covariance = run(brief, config), Window.covariance

    def failing(self, key):
        if key >= pose_key(20):
            raise RuntimeError(GTSAM_SAYS.format(key))
        return covariance(self, key)

    monkeypatch.setattr(Window, "covariance", failing)
    result = run(brief, config)
    assert result.diagnostics.events == []
    assert np.allclose(result.poses, expected.poses, atol=1e-9)
    assert np.allclose(result.final.covariances, expected.final.covariances, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("lag", [None, 5.0])
def test_a_smoother_that_cannot_be_solved_says_so_in_one_line(lag, monkeypatch):
    def failing(_, key, **__):
        raise RuntimeError(GTSAM_SAYS.format(key))

    monkeypatch.setattr(isam.Incremental, "_marginal", failing)
    with pytest.raises(RunFailedError) as raised:
        run(simulate(seconds=3.0), RunConfig("smoother", {} if lag is None else {"lag": lag}))
    text = str(raised.value)
    assert "do not determine the pose at 0." in text
    assert "cannot be solved at" in text
    assert "\n" not in text


def test_a_batch_without_covariances_says_so_in_one_line(monkeypatch):
    def failing(*_):
        raise IndeterminateError(pose_key(4))

    monkeypatch.setattr(Problem, "covariances", failing)
    with pytest.raises(RunFailedError, match=r"cannot be solved at 3\.000 s: .* do not determine the pose at 0\.88"):
        run(simulate(seconds=3.0), RunConfig("batch"))


@pytest.fixture(scope="module")
def brief():
    return simulate(seconds=6.0, rate=3.0)


def failing_marginals(times, monkeypatch):
    """The marginals of a smoother fail from 3 s on so many times."""
    marginal, failures = isam.Incremental._marginal, []

    def failing(self, key, *known, **where):
        if self._graph.t >= 3.0 and len(failures) < times:
            failures.append(key)
            raise RuntimeError("made to fail")
        return marginal(self, key, *known, **where)

    monkeypatch.setattr(isam.Incremental, "_marginal", failing)


@pytest.mark.parametrize("lag", [None, 2.0, "all"])
def test_a_solver_that_fails_is_built_anew(lag, brief, monkeypatch):
    config = RunConfig("smoother", {"lag": lag})
    expected = run(brief, config)
    failing_marginals(1, monkeypatch)
    result = run(brief, config)
    assert [(event.kind, event.fields) for event in result.diagnostics.events] == [
        ("solver_rebuilt", {"why": "made to fail"})
    ]
    assert set(result.status) == {"localized"}
    assert np.abs(result.poses - expected.poses)[:, :2].max() < 0.02
    assert np.abs(result.final.poses - expected.final.poses)[:, :2].max() < 0.02


@pytest.mark.parametrize("lag", [None, 2.0])
def test_a_solver_that_fails_twice_ends_the_run(lag, brief, monkeypatch):
    failing_marginals(2, monkeypatch)
    with pytest.raises(RunFailedError, match=r"the graph cannot be solved at 3\.\d+ s: made to fail"):
        run(brief, RunConfig("smoother", {"lag": lag}))

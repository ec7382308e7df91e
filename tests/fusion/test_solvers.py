"""What the solvers make of a robot whose odometry constants are estimated, where nothing but its start ties it to the world."""

import camera_world
import gtsam
import landmark_world
import numpy as np
import pytest
from changed_logs import with_rig, with_stream

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.graph.graph import Node
from factorgraph_loc.fusion.graph.solver import Window
from factorgraph_loc.fusion.graph.summary import MarginalSummary
from factorgraph_loc.sensors.odometry.settings import OdometryUncertainty
from factors import se2
from factors.graph import is_pose, landmark_key, pose_array, pose_key, to_gtsam

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

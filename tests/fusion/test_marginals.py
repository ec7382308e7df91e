"""Covariances of graphs that are hardly determined, optima next to values without a cost, solvers that fail, and what a user is
told of failures."""

import gtsam
import numpy as np
import pytest
from landmark_world import simulate

from factorgraph_loc.errors import RunFailedError
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.graph import isam
from factorgraph_loc.fusion.graph.marginals import IndeterminateError, covariances
from factorgraph_loc.fusion.graph.problem import Problem
from factorgraph_loc.fusion.graph.solver import Window
from factors.graph import constants_key, pose_key

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
    log = simulate(seconds=12.0)
    config = RunConfig("smoother", {"lag": 5.0})
    expected, covariance = run(log, config), Window.covariance

    def failing(self, key):
        if key >= pose_key(20):
            raise RuntimeError(GTSAM_SAYS.format(key))
        return covariance(self, key)

    monkeypatch.setattr(Window, "covariance", failing)
    result = run(log, config)
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
def log():
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
def test_a_solver_that_fails_is_built_anew(lag, log, monkeypatch):
    config = RunConfig("smoother", {"lag": lag})
    expected = run(log, config)
    failing_marginals(1, monkeypatch)
    result = run(log, config)
    assert [(event.kind, event.fields) for event in result.diagnostics.events] == [
        ("solver_rebuilt", {"why": "made to fail"})
    ]
    assert set(result.status) == {"localized"}
    assert np.abs(result.poses - expected.poses)[:, :2].max() < 0.02
    assert np.abs(result.final.poses - expected.final.poses)[:, :2].max() < 0.02


@pytest.mark.parametrize("lag", [None, 2.0])
def test_a_solver_that_fails_twice_ends_the_run(lag, log, monkeypatch):
    failing_marginals(2, monkeypatch)
    with pytest.raises(RunFailedError, match=r"the graph cannot be solved at 3\.\d+ s: made to fail"):
        run(log, RunConfig("smoother", {"lag": lag}))

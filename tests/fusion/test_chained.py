"""The problem of a whole run as a row of poses, against GTSAM's elimination."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.fusion.graph.chained import Chained
from factorgraph_loc.fusion.graph.problem import Problem
from factors import se2
from factors.graph import PriorFactor, VectorPriorFactor, constants_key, landmark_key, pose_key
from factors.landmarks.factor import BearingRangeFactor
from factors.landmarks.model import PARAMETERS, BearingRangeModel
from factors.motion import Increment
from factors.odometry.factor import OdometryFactor

ODOMETRY, SENSOR = constants_key(0), constants_key(1)
MODEL = BearingRangeModel(mounting=(0.1, -0.05, 0.2), range_scale=1.03, depth=True, bearing_bias=0.01, robust=3.0)
POINTS = np.array(((4.0, 1.0), (5.0, -2.0), (3.0, 3.0), (6.0, 0.5)))


def look(rng, pose, **more):
    """What is seen of the points, one of them without a range and one without a bearing, the last far off."""
    at = se2.compose(se2.compose(pose, more.get("offset", np.zeros(3))), np.array(MODEL.mounting))
    local = se2.transform_to(at, POINTS)
    ranges, bearings = MODEL.range_scale * local[:, 0], np.arctan2(local[:, 1], local[:, 0]) + MODEL.bearing_bias
    ranges, bearings = ranges + 0.05 * rng.standard_normal(4), bearings + 0.02 * rng.standard_normal(4)
    ranges[0], bearings[1], ranges[3] = np.nan, np.nan, ranges[3] + 2.0
    return BearingRangeFactor(MODEL, POINTS, ranges, bearings, **more)


@pytest.fixture
def run():
    """Eight poses; what looks may have beside their points, each once."""
    rng = np.random.default_rng(3)
    step, covariance = np.array((0.3, 0.02, 0.1)), np.diag((0.02, 0.01, 0.02)) ** 2
    spreads = np.array([np.diag((0.1, 0.2)) ** 2] * 4)
    offset = {"offset": np.array((0.05, 0.01, 0.03)), "offset_covariance": np.diag((0.05, 0.04, 0.06)) ** 2}
    twist = {"twist": np.array((0.5, 0.0, 0.3))}
    extras = [{}, twist, offset, {**offset, **twist, "in_look": 7}, {"point_covariances": spreads}]
    extras.append({**offset, "point_covariances": spreads})
    constants = tuple(range(len(PARAMETERS)))
    factors = [(PriorFactor(np.zeros(3), covariance), (pose_key(0),))]
    factors += [(VectorPriorFactor(np.zeros(2), np.array((0.02, 0.01))), (ODOMETRY,))]
    factors += [(VectorPriorFactor(np.zeros(6), np.full(6, 0.02)), (SENSOR,))]
    pose, values = np.zeros(3), {ODOMETRY: np.array((0.01, -0.02)), SENSOR: 0.01 * np.arange(6.0)}
    for i in range(8):
        if i:
            moved = Increment(step + 0.01 * rng.standard_normal(3), covariance, 0.5, 0.1)
            factors.append((OdometryFactor(moved, (0, 2)), (pose_key(i - 1), pose_key(i), ODOMETRY)))
        factors.append((look(rng, pose, estimated=constants, **extras[i % 6]), (pose_key(i), SENSOR)))
        values[pose_key(i)] = se2.compose(pose, se2.exp(0.05 * rng.standard_normal(3)))
        pose = se2.compose(pose, step)
    return factors, values


def through_gtsam(factors):
    """The same problem, which is not told that it is a row."""
    problem = Problem(factors)
    problem.__dict__["_chain"] = None
    return problem


def test_the_solution_and_its_covariances_are_those_of_gtsams_elimination(run):
    factors, values = run
    ours, theirs = Problem(factors), through_gtsam(factors)
    assert ours._chain is not None
    assert ours._chain.cost(ours._chain.begin(values)) == pytest.approx(theirs.cost(values), rel=1e-12)
    found, expected = ours.solve(values), theirs.solve(values)
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    assert found.cost < 0.9 * theirs.cost(values)
    spreads, wanted = ours.covariances(expected.values, values), theirs.covariances(expected.values, values)
    for key, value in expected.values.items():
        np.testing.assert_allclose(found.values[key], value, atol=1e-8)
        np.testing.assert_allclose(spreads.by_key[key], wanted.by_key[key], rtol=1e-6, atol=1e-12)


def test_one_call_linearises_as_each_factor_does(run):
    """As the plain code of landmarks that are variables does, one by one."""
    factors, values = run
    for factor, keys in factors:
        if not isinstance(factor, BearingRangeFactor):
            continue
        at = [values[key] for key in keys]
        residual, found = factor.linearize(at)
        for i, point in enumerate(factor.points):
            spread = None if factor.point_covariances is None else factor.point_covariances[i : i + 1]
            seen = {"ranges": factor.ranges[i : i + 1], "bearings": factor.bearings[i : i + 1]}
            one = replace(factor, **seen, point_covariances=spread, free=True, in_look=factor.in_look or len(POINTS))
            error, (*blocks, _) = one.linearize([*at, point])
            rows = slice(2 * i, 2 * i + 2)
            np.testing.assert_allclose(residual[rows], error, atol=1e-12)
            for block, expected in zip(found, blocks, strict=True):
                np.testing.assert_allclose(block[rows], expected, atol=1e-12)


def test_loops_and_many_parameters_are_left_to_gtsam(run):
    factors, values = run
    closing = OdometryFactor(Increment(np.zeros(3), np.eye(3), 1.0))
    assert Problem([*factors, (closing, (pose_key(1), pose_key(5)))])._chain is None
    extra = {landmark_key(i): np.zeros(2) for i in range(20)}
    many = [(VectorPriorFactor(np.zeros(2), np.ones(2)), (key,)) for key in extra]
    assert Chained([*factors, *many]).begin(values | extra) is None

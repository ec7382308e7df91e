"""Compiled updates of a pose against those that NumPy makes of the same measurements."""

import math
from dataclasses import replace

import mounted_camera
import numpy as np
import pytest
from drives import variance
from scipy import optimize

from factorgraph_loc.sensors.base import ResidualObservation, Term
from factors import se2
from factors import update as robust_update_module
from factors.camera import update_kernels as pixel_kernels
from factors.camera.factor import ReprojectionFactor, image_update
from factors.camera.model import CameraModel, camera_pose, predict
from factors.landmarks.factor import BearingRangeFactor, landmark_update
from factors.landmarks.model import BearingRangeModel
from factors.landmarks.model import predict as predict_landmarks
from factors.motion import ChainState
from factors.odometry import kernels as odometry_kernels
from factors.odometry.model import (
    MINIMUM_HEADING_VARIANCE,
    MINIMUM_POSITION_VARIANCE,
    Growth,
    OdometryModel,
    relative_motion,
)
from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts
from factors.rfid.factor import RfidFactor
from factors.rfid.index import moved
from factors.rfid.model import Antenna, BeamModel, RfidModel
from factors.update import update_state

CLOSE = 1e-8  # standard deviations


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def by_pixels(factor, pose, covariance, iterations):
    """What :func:`image_update` makes of points, by NumPy."""
    twin, size = replace(factor, estimated=(2,)), len(covariance)

    def linearize(delta):
        residual, (by_pose, _, by_tilt) = twin.whitened([se2.compose(pose, se2.exp(delta[:3])), np.zeros(1)])
        jacobian = np.zeros((*residual.shape, size + 2))
        jacobian[..., :3], jacobian[..., size:] = by_pose, by_tilt
        return residual + by_tilt @ delta[size:], jacobian

    return update_state(linearize, covariance, factor.weight, iterations, factor.dof(), 1e-3, 2)


def spread(rng, size, scale):
    root = scale * rng.standard_normal((size, size))
    return root @ root.T + 1e-6 * np.eye(size)


def close(found, expected, sigmas):
    assert np.abs((found - expected) / sigmas).max() < CLOSE


@pytest.mark.parametrize("tempering", [1.0, 0.5])
@pytest.mark.parametrize("size", [3, 5])
@pytest.mark.parametrize("iterations", [1, 8])
def test_by_pixels(rng, iterations, size, tempering):
    model = CameraModel(500.0, 500.0, 320.0, 240.0, 640, 480, position=np.array((0.1, 0.0, 0.5)), tempering=tempering)
    for _ in range(10):
        pose = rng.standard_normal(3)
        position, rotation = camera_pose(model, pose)
        depth = rng.uniform(0.5, 8.0, 15)
        local = depth[:, None] * np.column_stack((rng.uniform(-0.6, 0.6, (15, 2)), np.ones(15)))
        points = position + local @ rotation.T
        pixels = predict(model, pose, points)[0] + rng.standard_normal((15, 2))
        pixels[0] += 50.0
        factor = ReprojectionFactor(model, points, pixels)
        start, covariance = se2.compose(pose, se2.exp(0.05 * rng.standard_normal(3))), spread(rng, size, 0.05)
        found = image_update(factor, start, covariance, iterations, 1e-3)
        expected = by_pixels(factor, start, covariance, iterations)
        sigmas = np.sqrt(np.diag(expected.covariance))
        close(found.delta, expected.delta, sigmas)
        close(found.covariance, expected.covariance, np.outer(sigmas, sigmas))
        np.testing.assert_allclose(found.residual, expected.residual, atol=1e-9)
        assert (found.nis, found.dof) == (pytest.approx(expected.nis), expected.dof)


@pytest.mark.parametrize("places", [(), (0, 3), (0, 1, 2, 3, 4), (2, 5)])
@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("iterations", [1, 5])
def test_by_landmarks(rng, iterations, depth, places):
    model = BearingRangeModel((0.1, -0.05, 0.2), 1.02, depth, 0.03, 0.05, 0.02, 0.01, 0.03)
    names, first = ("constants",) * bool(places), 5
    for count in (1, 2, 6):
        pose, constants = rng.standard_normal(3), 0.01 * rng.standard_normal(len(places))
        points = se2.transform_from(pose, rng.uniform((1.0, -2.0), (6.0, 2.0), (count, 2)))
        ranges, bearings = predict_landmarks(model, pose, points) + 0.03 * rng.standard_normal((2, count))
        ranges[0] += 3.0
        bearings[-1] = np.nan
        factor = BearingRangeFactor(model, points, ranges, bearings, estimated=places)
        if count > 1:  # seen after the pose, from a robot that moves, on a map that is not exact
            moved = {"offset": np.array((0.1, 0.0, 0.1)), "offset_covariance": 1e-4 * np.eye(3), "simultaneous": 8}
            spreads = np.tile(1e-3 * np.eye(2), (count, 1, 1))
            factor = replace(factor, **moved, twist=np.array((0.5, 0.0, 0.2)), point_covariances=spreads)
        start, covariance = (
            se2.compose(pose, se2.exp(0.05 * rng.standard_normal(3))),
            spread(rng, 6 + len(places), 0.05),
        )
        found = landmark_update(factor, start, covariance, constants, first, iterations)
        held = {"constants": constants}, {"constants": slice(first, first + len(places))}
        seen = ResidualObservation(0.0, (Term(factor, names, 2 * count),))
        expected = seen.correct(start, covariance, *held, iterations)
        sigmas = np.sqrt(np.diag(expected.covariance))
        close(found.delta, expected.delta, sigmas)
        close(found.covariance, expected.covariance, np.outer(sigmas, sigmas))
        np.testing.assert_allclose(found.residual, expected.residual, atol=1e-9)
        assert (found.nis, found.dof) == (pytest.approx(expected.nis), expected.dof)


def test_landmarks_that_compiled_code_leaves_to_others():
    factor = BearingRangeFactor(BearingRangeModel(), np.ones((1, 2)), np.ones(1), np.zeros(1))
    singular = np.ones((3, 3)), np.zeros(0), 3, 1
    assert landmark_update(factor, np.zeros(3), *singular) is None
    assert landmark_update(replace(factor, free=True), np.zeros(3), np.eye(3), np.zeros(0), 3, 1) is None


@pytest.mark.parametrize("iterations", [1, 4])
def test_by_what_antennas_read_and_did_not_read(rng, iterations):
    antennas = tuple(Antenna(x=0.2, z=1.0, yaw=yaw) for yaw in (-1.5, 0.0, 1.5))
    model = RfidModel(antennas, (BeamModel(),), tempering=0.7)
    for scale in (0.02, 0.5) * 5:
        where = np.column_stack((rng.uniform(-8.0, 8.0, (15, 2)), rng.uniform(0.0, 2.0, 15)))
        likelihood = RfidLikelihood(model, TagArray(where, np.full(15, np.nan)))
        pose, offset = rng.standard_normal(3), 0.1 * rng.standard_normal(3)
        at = se2.compose(pose, offset)[None]
        shares = np.array([likelihood.probabilities(at, k)[0] for k in range(3)])
        hits = rng.binomial(2, shares).astype(np.int64)
        looks = TagReadCounts(np.tile(offset, (3, 1)), np.arange(3), np.full(3, 2), hits)
        start, covariance = se2.compose(pose, se2.exp(scale * rng.standard_normal(3))), spread(rng, 3, scale)
        factor, information = RfidFactor(likelihood, looks), np.linalg.inv(covariance)
        found, sigmas = factor.correct(start, covariance, iterations=iterations), np.sqrt(np.diag(covariance))

        def cost(delta, factor=factor, start=start, information=information):
            return factor.cost([se2.compose(start, se2.exp(delta))]) + 0.5 * delta @ information @ delta

        best = optimize.minimize(cost, np.zeros(3), method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-6})
        if iterations > 1 and scale < 0.1:
            assert np.abs((found.delta - best.x) / sigmas).max() < 0.2
        assert cost(found.delta) <= cost(np.zeros(3)) + 0.02
        there = factor.score([se2.compose(start, se2.exp(found.delta))]).information[0]
        assert np.linalg.eigvalsh(covariance - found.covariance)[0] > -1e-9
        if scale < 0.1:  # as far as it has moved the information is the same
            np.testing.assert_allclose(
                np.linalg.inv(found.covariance), information + there, rtol=0.1, atol=0.2 * information.max()
            )


def test_offsets_of_looks_are_moved_as_poses_are(rng):
    offset, offsets = rng.standard_normal(3), rng.standard_normal((4, 3))
    np.testing.assert_allclose(moved(offset, offsets), se2.compose(offset, offsets), atol=1e-12)


def seen(covariance, sigma, iterations=3):
    """An update by three landmarks of which range and bearing are known to ``sigma``."""
    model = BearingRangeModel(range_sigma=sigma, bearing_sigma=sigma, robust=100.0)
    points = np.array(((4.0, 1.0), (-2.0, 5.0), (1.0, -3.0)))
    ranges, bearings = predict_landmarks(model, np.array((0.1, -0.1, 0.02)), points)
    factor = BearingRangeFactor(model, points, ranges, bearings)

    def linearize(delta):
        residual, (by_pose,) = factor.whitened([se2.exp(delta[:3])])
        return residual, by_pose

    return update_state(linearize, covariance, factor.weight, iterations, factor.dof())


def test_an_update_by_roots_is_the_one_by_information(rng, monkeypatch):
    covariance = spread(rng, 5, 0.1)
    plain = seen(covariance, 0.05)
    rooted = robust_update_module._rooted(np.linalg.cholesky(covariance))
    monkeypatch.setattr(robust_update_module, "_informed", lambda _: rooted)
    rooted = seen(covariance, 0.05)
    np.testing.assert_allclose(rooted.delta, plain.delta, atol=1e-9)
    np.testing.assert_allclose(rooted.covariance, plain.covariance, atol=1e-12)
    assert rooted.nis == pytest.approx(plain.nis)


@pytest.mark.parametrize("scale", [1e-9, 1e6, 1e12])
@pytest.mark.parametrize("sigma", [1e-6, 1.0])
def test_an_update_of_what_is_singular_as_numbers_go_is_positive(scale, sigma):
    way = np.array((1.0, 2.0, 0.5))
    update = seen(scale * np.outer(way, way) + 1e-20 * np.eye(3), sigma)
    assert np.all(np.isfinite(update.delta))
    assert update.nis >= 0.0
    assert np.all(np.diag(update.covariance) > 0.0)
    sigmas = np.sqrt(np.diag(update.covariance))
    assert np.linalg.eigvalsh(update.covariance / np.outer(sigmas, sigmas))[0] > -1e-9


MODEL = OdometryModel(
    along=Growth(0.1, 0.02, 0.01), lateral=Growth(0.03, 0.01, 0.02), heading=Growth(0.05, 0.1, 0.002), direction=0.1
)
START = ChainState(1.0, 0.3, -0.2, 2.9, 4.0, 5.0, 0.5)
END = ChainState(1.7, 0.1, 0.4, 3.6, 4.9, 5.8, 0.6)


@pytest.mark.parametrize(("start", "end"), [(START, END), (END, START), (START, START)])
def test_relative_motion(start, end):
    found = relative_motion(MODEL, start, end)
    delta = se2.between(np.array(start[1:4]), np.array(end[1:4]))
    way = abs(end.path - start.path), abs(end.turn - start.turn), abs(end.t - start.t)
    unknown = max(0.0, end.unknown - start.unknown)
    along, lateral = (variance(g, *way) + MODEL.unknown_distance**2 * unknown for g in (MODEL.along, MODEL.lateral))
    along += (
        unknown * (way[0] / max(way[2], 1e-6)) ** 2 / 12.0
    )  # a share of the way that is uniform over a width of one
    heading = variance(MODEL.heading, *way) + MODEL.unknown_rotation**2 * unknown
    travel = MODEL.direction - delta[2] / 2.0
    turn = np.array(((math.cos(travel), -math.sin(travel)), (math.sin(travel), math.cos(travel))))
    # the heading's walk displaces the end across the chord, as seen from the end
    x, y = -se2.inverse(delta)[:2]
    across = np.array((-y, x))
    expected = np.zeros((3, 3))
    expected[:2, :2] = turn @ np.diag((along, lateral)) @ turn.T + heading * np.outer(across, across) / 3.0
    expected[:2, 2] = expected[2, :2] = heading * across / 2.0
    expected[2, 2] = heading
    expected += np.diag((MINIMUM_POSITION_VARIANCE, MINIMUM_POSITION_VARIANCE, MINIMUM_HEADING_VARIANCE))
    np.testing.assert_allclose(found.delta, delta, atol=1e-12)
    np.testing.assert_allclose(found.covariance, expected, atol=1e-12)
    assert found.duration == pytest.approx(way[2])


def test_an_increment_alone_is_recalibrated_as_with_its_jacobian(rng):
    increment, changes = relative_motion(MODEL, START, END), 0.1 * rng.standard_normal(4)
    alone = odometry_kernels.recalibrated(increment.delta, increment.moving, changes, np.arange(4))
    delta, _ = odometry_kernels.recalibrate(se2.log(increment.delta), increment.moving, changes)
    np.testing.assert_allclose(alone, delta, atol=1e-12)


CAMERA = replace(mounted_camera.MODEL, sigma=1.3, tempering=0.6)


def test_the_camera_of_a_robot_moves_as_the_robot_does(rng):
    pose, step = rng.standard_normal(3), 1e-6
    root = rng.standard_normal((3, 3))
    position, rotation, covariance = pixel_kernels.placed(CAMERA.position, CAMERA.rotation, 0.0, pose, root @ root.T)
    np.testing.assert_allclose(position, camera_pose(CAMERA, pose)[0])
    np.testing.assert_allclose(rotation, camera_pose(CAMERA, pose)[1])
    lift = np.empty((6, 3))
    for i, by in enumerate(step * np.eye(3)):
        there, turned = camera_pose(CAMERA, se2.compose(pose, se2.exp(by)))
        turn = (rotation.T @ turned - np.eye(3)) / step
        lift[:3, i] = turn[2, 1], turn[0, 2], turn[1, 0]
        lift[3:, i] = rotation.T @ (there - position) / step
    np.testing.assert_allclose(covariance, lift @ root @ root.T @ lift.T, atol=1e-4)

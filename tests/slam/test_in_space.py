"""Estimators of a robot that moves in space, on made-up runs and on the recorded one."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import short_logs
from scipy.stats import chi2
from space_world import POINTS, RIG, carried, with_features

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation import space
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.preparation import resolve_prior
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.registry import create, settings_of
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.model.measurement import Tick
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.settings import CameraUncertainty, DepthSettings
from factorgraph_loc.sensors.camera.stream import FeatureStream
from factorgraph_loc.slam.monoslam_state import Eye
from factorgraph_loc.slam.space_graph import SeenPoints
from factorgraph_loc.slam.space_motion import RobotState
from factorgraph_loc.slam.space_motion_models import pose_of


def estimated(log, name, sensors=None, **settings):
    return run(log, RunConfig(name, settings, sensors))


@cache
def of(seed, name, sensors=RIG.sensors):
    """The result of a run that several tests look at."""
    return estimated(carried(seed), name, sensors)


def at_the_end(log, *, forget=False):
    """The window when the last measurement has come, with ticks; ``forget``: it may forget what is older than a second."""
    setup = Setup(RIG, log.world, RIG.sensors, np.random.default_rng(1))
    estimator = create("space_smoother", setup, settings_of("space_smoother", {}))
    estimator.initialize(resolve_prior(log, None)[0])
    for m in log.measurements(RIG.sensors):
        estimator.process(m)
        estimator.process(Tick(m.t))
        if forget:
            estimator.forget(m.t - 1.0)
    return estimator


def nees(found, log, row=-1):
    errors = space.pose_errors(found, log.reference3.at(found.t))
    return float(errors[row] @ np.linalg.solve(found.covariances[row], errors[row]))


@pytest.mark.parametrize("sensors", [RIG.sensors, ("sightings", "sightings_right")], ids=["measured", "steady"])
def test_the_batch_is_where_the_smoothed_filter_is(sensors):
    """Both are the optimum of one problem, which is nearly linear, also where the velocity is what changes at random."""
    smoothed, batch = (of(1, name, sensors).final_space for name in ("monoslam", "space_batch"))
    apart = space.pose_errors(smoothed, batch)
    sigmas = np.sqrt(np.array([np.diag(c) for c in batch.covariances]))
    assert np.quantile(np.abs(apart) / sigmas, 0.95) < 0.3
    ratio = np.array([np.diag(c) for c in smoothed.covariances]) / sigmas**2
    assert np.median(ratio) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("sensors", [RIG.sensors, ("sightings", "sightings_right")], ids=["measured", "steady"])
def test_the_window_is_where_the_filter_is(sensors):
    """Both know the same at any time of a problem that is nearly linear."""
    filtered, window = (of(1, name, sensors).causal_space for name in ("monoslam", "space_smoother"))
    sigmas = np.sqrt(np.array([np.diag(c) for c in window.covariances]))
    assert np.quantile(np.abs(space.pose_errors(filtered, window)) / sigmas, 0.95) < 0.4
    ratio = np.array([np.diag(c) for c in filtered.covariances]) / sigmas**2
    assert np.median(ratio) == pytest.approx(1.0, abs=0.05)


def test_the_final_trajectory_of_the_window_is_that_of_the_batch():
    window, batch = (of(2, name).final_space for name in ("space_smoother", "space_batch"))
    np.testing.assert_array_equal(window.positions, batch.positions)
    np.testing.assert_array_equal(window.covariances, batch.covariances)


def test_what_leaves_the_window_is_not_lost():
    log = carried(3)
    whole, short = (estimated(log, "space_smoother", lag=lag).causal_space for lag in (100.0, 1.0))
    sigmas = np.sqrt(np.array([np.diag(c) for c in whole.covariances]))
    assert np.max(np.abs(space.pose_errors(short, whole)) / sigmas) < 0.01


def test_a_late_image_counts_once():
    """When all have come, what is known is what it would be without delay, but for the robust weights of before."""
    log = carried(3)
    late, whole = (at_the_end(one).estimate().space for one in (short_logs.late(log, "sightings_right"), log))
    sigmas = np.sqrt(np.diag(whole.covariance))
    np.testing.assert_array_less(np.abs(late.position - whole.position) / sigmas[3:], 0.4)
    np.testing.assert_allclose(np.diag(late.covariance), sigmas**2, rtol=0.02)


def test_a_whole_problem_forgets_nothing():
    log = carried(3)
    asked, whole = (at_the_end(log, forget=forget).space_trajectory() for forget in (True, False))
    np.testing.assert_array_equal(asked.positions, whole.positions)


@pytest.mark.parametrize("name", ["monoslam", "space_batch", "space_smoother"])
def test_a_camera_finds_its_place_in_the_map(name):
    log = carried(1)
    known = score(of(1, name), log)
    found = run(log, RunConfig(name, prior="unknown"))
    figures = score(found, log)
    assert figures["final.space_position_rmse"] < 1.1 * known["final.space_position_rmse"]
    assert figures["final.space_anees"] < 1.2 * known["final.space_anees"]
    assert not found.warnings


@pytest.mark.parametrize("name", ["monoslam", "space_batch", "space_smoother"])
def test_where_no_image_tells_the_place_there_is_no_trajectory(name):
    log = carried(1)
    empty = replace(log, world=World(points=PointMap.of(("elsewhere",), np.zeros((1, 3)))))
    found = run(empty, RunConfig(name, prior="unknown"))
    assert not len(found.final_space)
    assert "never localized" in found.warnings[0]


def test_features_of_a_map_are_tempered_in_the_batch_as_in_the_filter():
    log = with_features(carried(1), 0.05)
    smoothed, batch = estimated(log, "monoslam").final_space, estimated(log, "space_batch").final_space
    sigmas = np.sqrt(np.array([np.diag(c) for c in batch.covariances]))
    assert np.quantile(np.abs(space.pose_errors(smoothed, batch)) / sigmas, 0.95) < 0.3
    ratio = np.array([np.diag(c) for c in smoothed.covariances]) / sigmas**2
    assert np.median(ratio) == pytest.approx(1.0, abs=0.05)


def test_covariances_in_space_are_those_of_the_errors():
    """NEES of 8 independent runs, causal at their end and of the final ones in their middle: each fails a right one with 0.1 %."""
    causal, final, window = [], [], []
    for seed in range(8):
        log, result = carried(seed), of(seed, "space_smoother")
        final.append(nees(result.final_space, log, len(result.final_space) // 2))
        window.append(nees(result.causal_space, log))
        causal.append(nees(estimated(log, "monoslam", smooth=False).final_space, log))
    low, high = chi2.ppf((5e-4, 1.0 - 5e-4), 6 * 8)
    assert low < sum(causal) < high
    assert low < sum(window) < high
    assert low < sum(final) < high


def test_what_is_not_known_of_the_mounting_is_in_the_covariances():
    """NEES of 8 runs, each with a camera that is turned by 2 degrees or so: bounds that fail a right one with 0.1 %."""
    sigma, causal, final = 0.03, [], []
    for seed in range(8):
        log = carried(seed)
        turned = dict(
            zip(("roll", "pitch", "yaw"), sigma * np.random.default_rng(seed).standard_normal(3), strict=True)
        )
        wrong = {name: getattr(RIG.camera, name) + turn for name, turn in turned.items()}
        wrong["uncertainty"] = CameraUncertainty(**dict.fromkeys(turned, sigma))
        log = replace(log, rig=log.rig.model_copy(update={"camera": log.rig.camera.model_copy(update=wrong)}))
        result = estimated(log, "space_batch", ("twist", "sightings"))
        final.append(nees(result.final_space, log, len(result.final_space) // 2))
        causal.append(nees(estimated(log, "monoslam", ("twist", "sightings"), smooth=False).final_space, log))
    low, high = chi2.ppf((5e-4, 1.0 - 5e-4), 6 * 8)
    assert low < sum(causal) < high
    assert low < sum(final) < high


@pytest.mark.parametrize(
    ("sensors", "told"),
    [
        (("sightings",), False),
        (("twist", "sightings"), True),
        (("sightings", "sightings_right"), True),
    ],
    ids=["one eye", "motion", "two eyes"],
)
def test_who_cannot_know_the_scale_says_so(sensors, told):
    """NEES of the last position of 8 runs without a map: below what a right covariance exceeds once in 10,000."""
    found = []
    for seed in range(8):
        log = carried(seed)
        result = run(log, RunConfig("monoslam", {"landmarks": "unknown"}, sensors))
        assert any("scale is unknown" in text for _, text in result.diagnostics.events) is not told
        errors = space.pose_errors(result.final_space, log.reference3.at(result.final_space.t))[-1, 3:]
        found.append(errors @ np.linalg.solve(result.final_space.covariances[-1, 3:, 3:], errors))
    assert sum(found) < chi2.ppf(1.0 - 1e-4, 3 * 8)


def with_depths(log, rng, **settings):
    """What the left camera sees without names, and how deep it is."""
    featured = with_features(log, 1.0)
    camera = featured.rig.camera.model_copy(update={"depth": DepthSettings(**settings)})
    model, frames = camera.model(), []
    for frame in featured.streams["camera"].frame:
        at = log.reference3.at(np.array((frame.t,)))
        local = (POINTS[frame.tracks] - at.positions[0]) @ at.rotations[0] - model.position
        noise = model.depth_sigma * rng.standard_normal(len(local))
        frames.append(replace(frame, depths=1.0 / (1.0 / (local @ model.rotation)[:, 2] + noise)))
    rig = log.rig.model_copy(update={"sensors": ("camera",), "camera": camera})
    streams = {"camera": FeatureStream(featured.streams["camera"].t, frames)}
    return replace(featured, rig=rig, streams=streams)


def without_depths(log):
    """The same images, and no depth image."""
    flat = [replace(frame, depths=None) for frame in log.streams["camera"].frame]
    return replace(log, streams={"camera": replace(log.streams["camera"], frame=flat)})


def test_depths_tell_the_scale_of_one_camera():
    """NEES of the last position of 8 runs, as above, and far smaller errors; without depth images the scale is unknown."""
    found, errors, unknown = [], [], []
    for seed in range(8):
        log = replace(with_depths(carried(seed), np.random.default_rng(seed)), world=World())
        config = RunConfig("monoslam", {"landmarks": "unknown"}, ("camera",))
        result = run(log, config)
        assert not any("scale is unknown" in text for _, text in result.diagnostics.events)
        last = result.final_space
        error = space.pose_errors(last, log.reference3.at(last.t))[-1, 3:]
        errors.append(np.linalg.norm(error))
        found.append(error @ np.linalg.solve(last.covariances[-1, 3:, 3:], error))
        flat = run(without_depths(log), config)
        assert any("scale is unknown" in text for _, text in flat.diagnostics.events)
        blind = flat.final_space
        unknown.append(np.linalg.norm(space.pose_errors(blind, log.reference3.at(blind.t))[-1, 3:]))
    assert sum(found) < chi2.ppf(1.0 - 1e-4, 3 * 8)
    assert np.median(errors) < 0.4 * np.median(unknown)


@pytest.mark.parametrize("name", ["monoslam", "space_smoother"])
def test_depths_of_points_of_a_map_are_measurements(name):
    """Errors of 8 runs are far smaller with precise depths, and NEES of these at the end, and of the final ones in the middle, are
    within bounds that fail right covariances with 0.1 %. A tenth of the depths is missing."""
    causal, final, errors, flat = [], [], [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        log = with_depths(carried(seed), rng, inverse_sigma=1e-3)
        for frame in log.streams["camera"].frame:
            frame.depths[rng.random(len(frame.depths)) < 0.1] = np.nan
        result = estimated(log, name)
        causal.append(nees(result.causal_space, log))
        final.append(nees(result.final_space, log, len(result.final_space) // 2))
        errors.append(score(result, log)["causal.space_position_rmse"])
        flat.append(score(estimated(without_depths(log), name), log)["causal.space_position_rmse"])
    low, high = chi2.ppf((5e-4, 1.0 - 5e-4), 6 * 8)
    assert low < sum(causal) < high
    assert low < sum(final) < high
    assert np.mean(errors) < 0.7 * np.mean(flat)


def test_a_wrong_depth_does_little_where_its_pixel_is_right():
    """As at an edge: with a tenth of the depths 1 m too large, they still help, over 8 runs."""
    wrong, flat = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        log = with_depths(carried(seed), rng, inverse_sigma=1e-3)
        flat.append(score(estimated(without_depths(log), "space_batch"), log)["final.space_position_rmse"])
        for frame in log.streams["camera"].frame:
            frame.depths[rng.random(len(frame.depths)) < 0.1] += 1.0
        wrong.append(score(estimated(log, "space_batch"), log)["final.space_position_rmse"])
    assert np.mean(wrong) < 0.9 * np.mean(flat)


@pytest.mark.parametrize("depths", [None, np.array((2.9, np.nan, 3.4, 5.0))], ids=["pixels", "depths"])
def test_the_residual_of_an_image_has_the_derivatives_that_it_says(depths):
    """Central differences with steps of 1e-6: wrong by less than 1e-6 of the largest; all weights are 1."""
    rng = np.random.default_rng(3)
    points = rng.uniform((2.0, -1.0, -1.0), (4.0, 1.0, 0.5), (4, 3))
    spreads = np.array([a @ a.T for a in 0.01 * rng.standard_normal((4, 3, 3))])
    model = replace(RIG.camera.model(), robust=100.0)
    robot = RobotState(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    pixels = Eye.of(model).known(robot, points, None).pixels + rng.standard_normal((4, 2))
    image = SeenPoints(0.0, Eye.of(model), pixels, points, spreads, 0.5, depths)
    pose = pose_of(robot)
    residual = image.linearize(pose)[0]
    assert image.cost(pose) == pytest.approx(0.5 * residual @ residual)
    image = replace(image, spreads=None)  # they change with the pose, which is ignored
    residual, jacobian = image.linearize(pose)
    assert len(residual) == image.size
    if depths is not None:  # nothing is known of the one without
        assert not residual[5]
        assert not jacobian[5].any()
    for k, step in enumerate(1e-6 * np.eye(6)):
        ahead, back = (image.linearize(pose.retract(sign * step))[0] for sign in (1.0, -1.0))
        np.testing.assert_allclose((ahead - back) / 2e-6, jacobian[:, k], atol=1e-6 * np.abs(jacobian).max())


def test_figures_in_space():
    log = carried(2)
    figures = score(of(2, "monoslam"), log)
    assert figures["causal.space_position_rmse"] < 0.03
    assert figures["final.space_position_rmse"] < figures["causal.space_position_rmse"]
    assert figures["final.space_rotation_rmse"] < 0.01
    assert figures["causal.position_rmse"] is None  # there is no planar reference
    assert space.accuracy(None, log.reference3) == dict.fromkeys(space.FIGURES)


def test_the_right_eye_alone_tells_the_pose_as_well():
    log = carried(3)
    figures = score(estimated(log, "monoslam", ("twist", "sightings_right")), log)
    assert figures["final.space_position_rmse"] < 0.03


def test_constant_velocity_stands_in_for_measured_motion():
    log = carried(4)
    figures = score(estimated(log, "monoslam", ("sightings", "sightings_right")), log)
    assert figures["causal.space_position_rmse"] < 0.08
    assert figures["final.space_position_rmse"] < 0.5 * figures["causal.space_position_rmse"] + 0.01
    assert figures["causal.space_coverage_95"] > 0.9


@pytest.mark.parametrize("name", ["dead_reckoning", "ekf", "particle_filter", "smoother", "batch"])
def test_planar_estimators_refuse(name):
    with pytest.raises(InputError, match="moves in space, expected one of monoslam, space_batch, space_smoother"):
        estimated(carried(5), name)


def test_what_the_batch_refuses():
    log = carried(5)
    with pytest.raises(InputError, match="expected planar = false"):
        estimated(log, "space_batch", planar=True)
    planar = replace(log, reference=log.reference3.planar(), reference3=None)
    with pytest.raises(InputError, match="expected one in space"):
        estimated(planar, "space_batch")


@pytest.mark.parametrize("name", ["monoslam", "space_batch", "space_smoother"])
def test_asking_changes_no_answer(name):
    """What is known at the end is the same to the last bit, whatever was asked on the way."""
    log = carried(4)
    sensors, prior = RIG.sensors, resolve_prior(log, None)[0]
    quiet, asked = (
        create(name, Setup(RIG, log.world, sensors, np.random.default_rng(1)), settings_of(name, {})) for _ in range(2)
    )
    for estimator in (quiet, asked):
        estimator.initialize(prior)
        for i, m in enumerate(log.measurements(sensors)):
            estimator.process(m)
            if i % 10 == 9:
                estimator.process(Tick(m.t))
            if estimator is asked and i % 50 == 30:
                estimator.estimate(m.t + 1.0)
                estimator.belief(m.t + 0.5)
                estimator.learnt()
                estimator.trajectory()
    for _ in range(2):
        found, expected = asked.space_trajectory(), quiet.space_trajectory()
        np.testing.assert_array_equal(found.positions, expected.positions)
        np.testing.assert_array_equal(found.covariances, expected.covariances)
    assert repr(asked.diagnostics) == repr(quiet.diagnostics)
    np.testing.assert_array_equal(asked.estimate().pose, quiet.estimate().pose)

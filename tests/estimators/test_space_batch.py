"""Estimators of a robot that moves in space, on made-up runs and on the recorded one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from factorgraph_loc.camera_settings import CameraSettings
from factorgraph_loc.errors import InputError
from factorgraph_loc.estimators.registry import Setup, create, settings_of
from factorgraph_loc.evaluation import space
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.prior import resolve_prior
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.log import FeatureStream, Log, RightSightingStream, SightingStream, TwistStream, cut
from factorgraph_loc.measurements import CameraFrame, Tick
from factorgraph_loc.points import PointMap
from factorgraph_loc.readers import load
from factorgraph_loc.rig import Rig, TwistSettings
from factorgraph_loc.trajectory3 import Trajectory3
from factorgraph_loc.world import World
from factors.reprojection import linearize_in_space

STEP, SECONDS, SIGMA = 0.1, 8.0, 2.0
SHIFT, TURN = (0.02, 0.03, 0.04), (0.03, 0.02, 0.05)
LENS = {"fx": 450.0, "fy": 450.0, "cx": 320.0, "cy": 240.0, "pixel_sigma": SIGMA}
RIG = Rig(
    sensors=("twist", "sightings", "sightings_right"),
    twist=TwistSettings(shift=SHIFT, turn=TURN),
    camera=CameraSettings(x=0.05, y=0.1, roll=0.1, pitch=0.2, **LENS),
    camera_right=CameraSettings(x=0.05, y=-0.1, roll=0.1, pitch=0.2, **LENS),
)
POINTS = np.random.default_rng(11).uniform((2.0, -2.0, -1.5), (4.0, 2.0, 1.0), (15, 3))


def carried(seed):
    """A vehicle that sways and turns about all axes in front of 15 points, which both cameras see; its motion is measured."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(SECONDS / STEP) + 1) * STEP
    v = np.column_stack((0.3 * np.cos(t), 0.4 * np.sin(0.7 * t), 0.2 * np.cos(1.3 * t)))
    w = np.column_stack((0.3 * np.cos(1.1 * t), 0.2 * np.sin(0.9 * t), 0.3 * np.cos(0.8 * t)))
    noise = rng.standard_normal((2, len(t), 3))
    true_v = v + noise[0] * SHIFT / np.sqrt(STEP)
    true_w = w + noise[1] * TURN / np.sqrt(STEP)
    positions, rotations = [np.zeros(3)], [np.eye(3)]
    for i in range(len(t) - 1):
        half = Rotation.from_rotvec(true_w[i] * STEP / 2.0).as_matrix()
        positions.append(positions[-1] + rotations[-1] @ half @ true_v[i] * STEP)
        rotations.append(rotations[-1] @ half @ half)
    truth = Trajectory3(t, np.array(positions), np.array(rotations))
    names = [f"p{i}" for i in range(len(POINTS))]
    world = World(points=PointMap.of(names, POINTS))
    streams = {"twist": TwistStream(t, v, w)}
    for sensor, kind, settings in (
        ("sightings", SightingStream, RIG.camera),
        ("sightings_right", RightSightingStream, RIG.camera_right),
    ):
        model, rows, seen = settings.model(), [], []
        for k in range(1, len(t)):
            camera = positions[k] + rotations[k] @ model.position
            pixels, *_ = linearize_in_space(model, camera, rotations[k] @ model.rotation, POINTS)
            ahead = ((POINTS - camera) @ rotations[k] @ model.rotation)[:, 2] > 0.3
            visible = np.flatnonzero(ahead & model.contains(pixels))
            rows += [(k, i) for i in visible.tolist()]
            seen.append(pixels[visible] + SIGMA * rng.standard_normal((len(visible), 2)))
        k, i = np.array(rows).T
        streams[sensor] = kind(t[k], [names[j] for j in i.tolist()], *np.concatenate(seen).T)
    return Log("carried", RIG, world, streams, reference3=truth)


def with_features(log, tempering):
    """What the left camera sees has no name, but looks like what was seen of the same point from the start."""
    rng = np.random.default_rng(12)
    looks = rng.standard_normal((len(POINTS), 64)).astype(np.float32)
    rows, seen = np.arange(len(POINTS)), log.streams["sightings"]
    points = replace(
        PointMap.of([f"p{i}" for i in rows], POINTS),
        feature="colour",
        owners=rows,
        descriptors=looks,
        seen_from=np.zeros((len(rows), 3)),
        sizes=np.full(len(rows), 5.0),
    )
    t, frames = np.unique(seen.t), []
    for stamp in t.tolist():
        at = np.flatnonzero(seen.t == stamp)
        which = np.array([int(seen.point[i][1:]) for i in at])
        pixels = np.column_stack((seen.u[at], seen.v[at]))
        frames.append(CameraFrame(stamp, "colour", pixels, np.full(len(at), 5.0), looks[which], which))
    camera = log.rig.camera.model_copy(update={"tempering": tempering})
    rig = log.rig.model_copy(update={"sensors": ("twist", "camera"), "camera": camera})
    streams = {"twist": log.streams["twist"], "camera": FeatureStream(t, frames)}
    return replace(log, rig=rig, world=World(points=points), streams=streams)


def estimated(log, name, sensors=None, **settings):
    return run(log, RunConfig(name, settings, sensors))


def nees(found, log, row=-1):
    errors = space.pose_errors(found, log.reference3.at(found.t))
    return float(errors[row] @ np.linalg.solve(found.covariances[row], errors[row]))


def test_the_batch_is_where_the_smoothed_filter_is():
    """Both are the optimum of one problem, which is nearly linear."""
    log = carried(1)
    smoothed, batch = estimated(log, "monoslam").final_space, estimated(log, "space_batch").final_space
    apart = space.pose_errors(smoothed, batch)
    sigmas = np.sqrt(np.array([np.diag(c) for c in batch.covariances]))
    assert np.quantile(np.abs(apart) / sigmas, 0.95) < 0.3
    ratio = np.array([np.diag(c) for c in smoothed.covariances]) / sigmas**2
    assert np.median(ratio) == pytest.approx(1.0, abs=0.05)


def test_features_of_a_map_are_tempered_in_the_batch_as_in_the_filter():
    log = with_features(carried(1), 0.05)
    smoothed, batch = estimated(log, "monoslam").final_space, estimated(log, "space_batch").final_space
    sigmas = np.sqrt(np.array([np.diag(c) for c in batch.covariances]))
    assert np.quantile(np.abs(space.pose_errors(smoothed, batch)) / sigmas, 0.95) < 0.3
    ratio = np.array([np.diag(c) for c in smoothed.covariances]) / sigmas**2
    assert np.median(ratio) == pytest.approx(1.0, abs=0.05)


def test_covariances_in_space_are_those_of_the_errors():
    """NEES of 8 independent runs, causal at their end and of the batch in their middle: each fails a right one with 0.1 %."""
    causal, final = [], []
    for seed in range(8):
        log = carried(seed)
        result = estimated(log, "space_batch")
        final.append(nees(result.final_space, log, len(result.final_space) // 2))
        causal.append(nees(estimated(log, "monoslam", smooth=False).final_space, log))
    low, high = chi2.ppf((5e-4, 1.0 - 5e-4), 6 * 8)
    assert low < sum(causal) < high
    assert low < sum(final) < high


def test_figures_in_space():
    log = carried(2)
    figures = score(estimated(log, "monoslam"), log)
    assert figures["causal.space_position_rmse"] < 0.03
    assert figures["final.space_position_rmse"] < figures["causal.space_position_rmse"]
    assert figures["final.space_rotation_rmse"] < 0.01
    assert figures["causal.position_rmse"] is None  # there is no planar reference
    residuals = space.reprojection_residuals(log.reference3, log, "sightings_right")
    assert space.spread_of(residuals)["u_rms"] == pytest.approx(SIGMA, rel=0.1)
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


def test_a_random_walk_stands_in_for_measured_motion_in_the_batch():
    log = carried(4)
    figures = score(estimated(log, "space_batch", ("sightings", "sightings_right")), log)
    assert figures["final.space_position_rmse"] < 0.06


@pytest.mark.parametrize("name", ["dead_reckoning", "ekf", "particle_filter", "smoother", "batch"])
def test_planar_estimators_refuse(name):
    with pytest.raises(InputError, match="moves in space, expected one of monoslam, space_batch"):
        estimated(carried(5), name)


def test_what_the_batch_refuses():
    log = carried(5)
    with pytest.raises(InputError, match="expected planar = false"):
        estimated(log, "space_batch", planar=True)
    planar = replace(log, reference=log.reference3.planar(), reference3=None)
    with pytest.raises(InputError, match="expected one in space"):
        estimated(planar, "space_batch")


def test_recorded_starry_night(data_root):
    """Its first 30 s. The estimated poses explain the pixels better than those of the motion capture do."""
    (log,) = load("starry_night", data_root=data_root)
    log = cut(log, 0.0, 30.0)
    result, batch = estimated(log, "monoslam"), estimated(log, "space_batch")
    figures = score(result, log)
    assert figures["causal.space_position_rmse"] < 0.05
    assert figures["final.space_position_rmse"] < 0.05
    assert np.median(np.abs(space.pose_errors(result.final_space, batch.final_space)[:, 3:])) < 0.002
    found = space.spread_of(space.reprojection_residuals(batch.final_space, log))
    assert found["u_mad"] < 0.5 * space.spread_of(space.reprojection_residuals(log.reference3, log))["u_mad"]


@pytest.mark.parametrize("name", ["monoslam", "space_batch"])
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

"""The paper's EKF: against the planar EKF, its consistency, its map, and what must not break it."""

from dataclasses import replace

import numpy as np
import pytest
from by_hand import made
from drives import even_noise
from scipy.stats import chi2

from factorgraph_loc import IncrementOdometry, PixelSightings, PointMap, Rig, World
from factorgraph_loc.evaluation.metrics import errors
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.sensors.odometry.settings import OdometrySettings
from factorgraph_loc.simulation import preset, simulate
from factorgraph_loc.slam.monoslam_state import Innovation
from factors.camera import model as reprojection
from factors.camera.model import CameraModel, TiltScale

SENSORS = ("odometry", "sightings")
EXACT_FLOOR = {"height_sigma": 1e-4, "tilt_sigma": 1e-4}  # which the simulated one is
TILT = CameraModel(1.0, 1.0, 0.0, 0.0, 1, 1).tilt
ALIKE_FLOOR = {"height_sigma": 1e-4, "tilt_sigma": TILT}  # as the planar estimators take it to be
SECONDS = 30.0


@pytest.fixture(scope="module")
def drive():
    """``drive(seed, **pixels)``: a simulated run among 300 points."""

    def make(seed, seconds=SECONDS, **pixels):
        changes = {
            "world": {"points": 300, "tags": 20},
            "world_seed": 5,
            "drive": {"duration": seconds},
            "pixels": pixels,
        }
        return simulate(preset("office", changes), seed)

    return make


def estimated(log, name="monoslam", **settings):
    return run(log, RunConfig(name, settings, SENSORS))


def test_in_a_known_map_it_is_the_planar_filter(drive, monkeypatch):
    monkeypatch.setattr(
        TiltScale, "learnt", lambda floor, *_: (floor, floor.sigma)
    )  # as monoslam's, which is a setting
    log = drive(1)
    ours = estimated(log, **ALIKE_FLOOR, iterations=8)
    planar = estimated(log, "ekf")
    sigmas = np.sqrt(planar.covariances[:, [0, 1, 2], [0, 1, 2]])
    seen = planar.t > 2.0  # until then the start is far off, and the two linearise differently
    assert np.quantile(np.abs(ours.poses - planar.poses)[seen] / sigmas[seen], 0.95) < 0.3
    assert np.median(ours.covariances[seen, 0, 0] / planar.covariances[seen, 0, 0]) == pytest.approx(1.0, abs=0.1)
    assert np.median(np.abs(ours.final.poses - planar.final.poses)) < 1e-3
    assert set(ours.learnt.values) == set(planar.learnt.values)
    for name, (value, sigma) in ours.learnt.values.items():
        assert value == pytest.approx(planar.learnt.values[name][0], abs=0.25 * sigma)
        assert sigma == pytest.approx(planar.learnt.values[name][1], rel=0.1)


def test_its_covariance_is_that_of_its_errors(drive):
    """NEES at the end of 6 independent runs: a right filter fails with 0.1 %."""
    last = []
    for seed in range(6):
        log = drive(seed, seconds=12.0)
        result = estimated(log, **EXACT_FLOOR)
        last.append(errors(result.causal(), log.reference).nees[-1])
    low, high = chi2.ppf((5e-4, 1.0 - 5e-4), 3 * len(last))
    assert low < sum(last) < high


CAMERA = preset("office", {}).rig.camera
EXACT_WHEELS = OdometrySettings(noise=even_noise(per_distance=1e-3))
RIG = Rig(sensors=SENSORS, odometry=EXACT_WHEELS, camera=CAMERA.model_copy(update={"pixel_sigma": 0.5}))
FAR_POINT = np.array((4.0, 2.5, 1.4))


def started(world, sensors=SENSORS, **settings):
    estimator = made("monoslam", RIG, world, sensors, **settings)
    estimator.initialize(PosePrior(0.0, np.zeros(3), 1e-8 * np.eye(3)))
    estimator.process(IncrementOdometry(0.0, 0.0, 0.0, 0.0))
    return estimator


def test_the_depth_of_one_point_is_found_by_moving():
    """Seen along 2 m of a straight way, once the depth is certain it is x, y, z, at the truth within three deviations."""
    estimator = started(World(), landmarks="unknown", **EXACT_FLOOR)
    rng, model = np.random.default_rng(3), RIG.camera.model()
    for i in range(40):
        t = 0.2 * i
        if i:
            estimator.process(IncrementOdometry(t, 0.05, 0.0, 0.0))
        pixels, depths = reprojection.predict(model, np.array((0.05 * i, 0.0, 0.0)), FAR_POINT[None])
        assert depths[0] > 0.0
        estimator.process(PixelSightings(t, ("p",), pixels + 0.5 * rng.standard_normal((1, 2))))
        if i == 1:
            assert not estimator.learnt().landmarks  # its depth is unknown still
    found = estimator.learnt().landmarks["p"]
    error = found.position - FAR_POINT[:2]
    assert np.hypot(*error) < 0.3
    assert error @ np.linalg.solve(found.covariance, error) < chi2.ppf(0.997, 2)


def test_a_point_behind_the_camera_is_no_catastrophe():
    world = World(points=PointMap.of(["behind", "ahead"], np.array(((-3.0, 0.1, 1.0), (4.0, 0.1, 1.0)))))
    estimator = started(world)
    estimator.process(PixelSightings(0.1, ("behind", "ahead"), np.array(((320.0, 240.0), (300.0, 200.0)))))
    estimate = estimator.estimate()
    assert np.all(np.isfinite(estimate.pose))
    assert np.hypot(*estimate.pose[:2]) < 0.1


def test_what_it_cannot_use_is_counted(drive):
    log = drive(1, seconds=5.0)
    rounds = run(log, RunConfig("monoslam", {}, ("odometry", "rfid"))).diagnostics.ignored
    assert rounds["rfid"] > 0
    estimator = started(World(), sensors=("odometry",))
    estimator.process(PixelSightings(0.1, ("p",), np.zeros((1, 2))))
    assert estimator.diagnostics.ignored == {"camera": 1}


def test_an_innovation_that_rounding_made_singular_still_has_a_gain():
    """As of a robot that is known to a million kilometres, by pixels with no noise to speak of."""
    direction = np.arange(1.0, 5.0)
    innovation = Innovation(np.ones((12, 4)), np.zeros((4, 0)), np.arange(0), 1e20 * np.outer(direction, direction))
    root, spread = innovation.gain(np.broadcast_to(1e-4 * np.eye(2), (2, 2, 2)))
    assert np.allclose(root @ root.T, innovation.covariance, rtol=1e-9)
    assert np.all(np.isfinite(spread))


def test_wheels_that_rest_while_it_turns_are_told_by_the_points():
    """While it turns by some 0.35 rad. The heading was off by a third of that."""
    world = {"points": 900, "tags": 20}
    log = simulate(preset("office", {"world": world, "world_seed": 5, "drive": {"duration": SECONDS}}), 5)
    rows = log.streams["odometry"]
    parts = [(rows.t >= t) & (rows.t < t + 0.6) for t in np.arange(8.0, 25.0, 0.1)]
    rests = min(parts, key=lambda part: abs(abs(rows.dtheta[part].sum()) - 0.35))
    slid = replace(rows, dtheta=np.where(rests, 0.0, rows.dtheta))
    result = estimated(replace(log, streams={**log.streams, "odometry": slid}), landmarks="unknown")
    assert errors(result.causal(), log.reference).heading[-20:].mean() < 0.03

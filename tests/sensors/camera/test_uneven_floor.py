"""A robot whose floor is not level: roll and pitch that no estimator in the plane knows."""

from dataclasses import replace

import numpy as np
from camera_world import CAMERA, room, simulate
from scipy.spatial.transform import Rotation

from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.sensors.camera.known_points import lifted
from factors.camera import model as reprojection
from factors.camera.factor import ReprojectionFactor

SEEDS = (3, 4, 5)
PERIODS = (4.1, 2.7)  # s, of roll and pitch
SWAY = 0.014  # rad, at most; a pixel is 0.002 rad


def standing(pose, roll, pitch):
    """Position and rotation of the camera of a robot that tilts."""
    turn = Rotation.from_euler("ZYX", (pose[2], pitch, roll)).as_matrix()
    return reprojection.mounted(CAMERA.model(), np.array((pose[0], pose[1], 0.0)), turn)


def uneven(log):
    """The log with its pixels as seen by a robot that sways."""
    stream, points, model = log.streams["sightings"], log.world.points, log.rig.camera.model()
    u, v = stream.u.copy(), stream.v.copy()
    for t in np.unique(stream.t):
        rows = np.flatnonzero(stream.t == t)
        pose, seen = (
            log.reference.at(np.array((t,)))[0],
            points.positions[[points.index[stream.point[i]] for i in rows]],
        )
        camera = standing(pose, *(SWAY * np.sin(2.0 * np.pi * t / period) for period in PERIODS))
        moved = reprojection.linearize_in_space(model, *camera, seen)[0] - reprojection.predict(model, pose, seen)[0]
        u[rows] += moved[:, 0]
        v[rows] += moved[:, 1]
    return replace(log, streams={**log.streams, "sightings": replace(stream, u=u, v=v)})


def test_roll_and_pitch_are_found_with_the_points_of_an_image():
    model, points, rng = CAMERA.model(), room().positions, np.random.default_rng(2)
    pose = np.array((1.0, -1.0, 0.4))
    upright, depth = reprojection.predict(model, pose, points)
    rows = np.flatnonzero(model.contains(upright) & (depth > 0.3))
    points = points[rows]
    pixels = reprojection.linearize_in_space(model, *standing(pose, 0.02, -0.015), points)[0]
    pixels += rng.standard_normal(pixels.shape)

    error, tilt = ReprojectionFactor(model, points, pixels).levelled([pose])

    # some 30 points tell an angle to 1 px / 500 px / sqrt(30) or twice that: five of these
    np.testing.assert_allclose(model.tilt * tilt, (0.02, -0.015), atol=0.004)
    assert np.sqrt(np.mean(error**2)) < 1.5  # px, of 1 and of what the prior of the tilt leaves; of 12 px without it


def test_the_camera_moves_with_a_robot_that_tilts():
    model, pose = CAMERA.model(), np.array((1.0, 2.0, 0.7))
    position, rotation = standing(pose, 0.0, 0.0)
    columns = []
    for tilts in ((model.tilt, 0.0), (0.0, model.tilt)):
        there, turned = standing(pose, *tilts)
        turn = Rotation.from_matrix(rotation.T @ turned).as_rotvec()
        columns.append(np.concatenate((turn, rotation.T @ (there - position))))

    np.testing.assert_allclose(
        lifted(model, pose, np.zeros((3, 3))).covariance, np.transpose(columns) @ columns, atol=2e-6
    )


def test_covariances_hold_where_the_points_are_estimated_too():
    found = []
    for seed in SEEDS:
        log = uneven(simulate(seconds=20.0, seed=seed, limit=60))
        scores = score(run(log, RunConfig("smoother", {"landmarks": "unknown"})), log)
        found.append([scores[figure] for figure in ("final.aligned_position_rmse", "causal.anees", "final.anees")])
    position, causal, final = np.mean(found, axis=0)
    assert position < 0.1  # of 0.25 where the points take the tilt for theirs
    # of three drives, whose errors come from one drift each: five standard deviations of 9 degrees of freedom are below 10
    assert max(causal, final) < 10.0

"""Pose graphs: what is in them, and that another program's optimiser gets the same from them."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factorgraph_loc import Trajectory, World
from factorgraph_loc.exports.trajectories import write_g2o
from factorgraph_loc.model.belief import LearntPoint
from factorgraph_loc.model.measurement import TURN
from factorgraph_loc.sensors.motion import whole_motion
from factorgraph_loc.sensors.registry import moving
from factors import se2

SENSORS = ("odometry", "bearing_range")


def rows(path, kind):
    """The numbers of the rows of a kind."""
    lines = (line.split() for line in path.read_text().splitlines())
    return np.array([[float(v) for v in line[1:]] for line in lines if line[0] == kind])


def test_gtsam_reads_motions_and_poses(log, tmp_path):
    """At the truth, along which this odometry is exact, no edge pulls; a pose that is moved costs what its covariance says."""
    write_g2o(log, log.reference, SENSORS, tmp_path / "arc.g2o")
    factors, values = gtsam.readG2o(str(tmp_path / "arc.g2o"), False)
    assert (factors.size(), values.size()) == (60, 63)  # of the landmarks it takes the places alone
    assert np.allclose([values.atPose2(i).translation() for i in range(61)], log.reference.poses[:, :2])
    assert factors.error(values) == pytest.approx(0.0, abs=1e-8)
    shift = np.array((0.001, -0.002, 0.003))
    values.update(60, values.atPose2(60).retract(shift))
    states = [whole_motion(log, moving(SENSORS, TURN)).state(t) for t in log.reference.t[-2:]]
    covariance = whole_motion(log, moving(SENSORS, TURN)).relative(*states).covariance
    assert factors.error(values) == pytest.approx(0.5 * shift @ np.linalg.inv(covariance) @ shift, rel=0.02)


def test_landmarks_are_where_they_were_seen(log, tmp_path):
    write_g2o(log, log.reference, SENSORS, tmp_path / "arc.g2o")
    vertices = {int(row[0]): row[1:] for row in rows(tmp_path / "arc.g2o", "VERTEX_XY")}
    poses = {int(row[0]): row[1:] for row in rows(tmp_path / "arc.g2o", "VERTEX_SE2")}
    edges = rows(tmp_path / "arc.g2o", "EDGE_SE2_XY")
    assert len(edges) == len(log.streams["bearing_range"].t)
    assert rows(tmp_path / "arc.g2o", "FIX").ravel().tolist() == sorted(vertices)
    for pose, mark, x, y, xx, xy, yy in edges:
        assert np.allclose(se2.transform_from(poses[int(pose)], np.array((x, y))), vertices[int(mark)], atol=1e-6)
        weights = np.sort(np.linalg.eigvalsh(np.array(((xx, xy), (xy, yy)))))
        across = 1.0 / (0.05 * np.hypot(x, y)) ** 2
        assert np.allclose(weights, np.sort((1.0 / 0.1**2, across)), rtol=1e-4)


def test_poses_between_ticks_where_something_was_seen(log, tmp_path):
    every_second = Trajectory(log.reference.t[::2], log.reference.poses[::2])
    write_g2o(log, every_second, SENSORS, tmp_path / "arc.g2o")
    poses = rows(tmp_path / "arc.g2o", "VERTEX_SE2")[:, 1:]
    assert len(poses) == len(every_second) + 6  # six times of sightings lie between
    t = np.union1d(every_second.t, log.streams["bearing_range"].t)
    assert np.allclose(poses, log.reference.at(t), atol=1e-9)
    whole = poses[0]
    for motion in rows(tmp_path / "arc.g2o", "EDGE_SE2"):
        whole = se2.compose(whole, motion[2:5])
    assert np.allclose(whole, log.reference.poses[-1], atol=1e-9)


def test_learnt_landmarks_are_free(log, tmp_path):
    bare = replace(log, world=World())
    learnt = {"door": LearntPoint(np.array((2.0, 1.0)), np.eye(2))}
    write_g2o(bare, log.reference, SENSORS, tmp_path / "arc.g2o", learnt)
    assert rows(tmp_path / "arc.g2o", "VERTEX_XY").tolist() == [[61.0, 2.0, 1.0]]
    assert rows(tmp_path / "arc.g2o", "FIX").tolist() == [[0.0]]


def test_a_robot_at_rest_has_finite_information(log, tmp_path):
    still = replace(
        log.streams["odometry"], dx=0.0 * log.reference.t, dy=0.0 * log.reference.t, dtheta=0.0 * log.reference.t
    )
    write_g2o(replace(log, streams={"odometry": still}), log.reference, SENSORS, tmp_path / "arc.g2o")
    assert np.isfinite(rows(tmp_path / "arc.g2o", "EDGE_SE2")).all()

"""Runs are read back as they were written."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from evo.tools import file_interface
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from factorgraph_loc import ImageStream, InputError, PosePath, Trajectory, write_trajectory
from factorgraph_loc.drawing.figures import ellipses
from factorgraph_loc.experiments.output import write_run
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.exports import scene
from factorgraph_loc.exports.runs import find_runs, is_results, read_runs
from factorgraph_loc.io.readers.pose_file import read_matrices
from factorgraph_loc.sensors.camera import summary as pictures_of


def test_a_run_is_read_as_it_was(log, results):
    ekf, dead = reversed(read_runs(find_runs(results), log))
    again = run(log, RunConfig("ekf"))
    assert (ekf.name, dead.name) == ("ekf", "dead_reckoning")
    for trajectory, expected in ((ekf.causal, again.causal()), (ekf.final, again.final)):
        assert np.allclose(trajectory.t, expected.t, atol=1e-9)
        assert np.allclose(trajectory.poses, expected.poses, atol=1e-12)
        assert np.allclose(trajectory.covariances, expected.covariances, atol=1e-12)
    t, errors = ekf.series["error_position"]
    truth = log.reference.at(t)
    assert np.allclose(errors, np.hypot(*(ekf.causal.at(t) - truth)[:, :2].T), atol=1e-6)
    assert ekf.events == ((1.25, "a jump"),)


def test_one_run_or_all_of_a_comparison(results):
    one = results / "store" / "ek" / "ekf"
    assert is_results(one)
    assert [folder.estimator for folder in find_runs(one)] == ["ekf"]
    assert [folder.estimator for folder in find_runs(results)] == ["dead_reckoning", "ekf"]


def test_bad_folders(log, results, tmp_path):
    assert not is_results(tmp_path)
    with pytest.raises(InputError, match="contains no results, expected a folder that `fgloc run`"):
        find_runs(tmp_path)
    with pytest.raises(InputError, match="is a run on the log arc, expected a run on the log hall"):
        read_runs(find_runs(results), replace(log, name="hall"))
    with pytest.raises(InputError, match="is it a run of another log named arc"):
        read_runs(find_runs(results), replace(log, t0_ns=0))


def test_of_an_estimator_without_causal_estimates_the_final_ones_are_played(log, tmp_path):
    write_run(run(log, RunConfig("batch")), log, tmp_path / "batch")
    (batch,) = read_runs(find_runs(tmp_path / "batch"), log)
    assert len(batch.causal) == 0
    assert batch.played() is batch.final
    t, errors = batch.series["error_position"]
    assert np.array_equal(t, batch.final.t)
    assert errors.max() < 0.05


def lights_of(log):
    return {marks.layer: lights for marks, _, lights in scene.layers(log)}


def test_tags_are_lit_from_when_the_antenna_had_them(log):
    lights = lights_of(log)["tags"]
    assert np.allclose(lights.t, [1.0, 1.5, 1.8, 2.0, 2.3, 2.5])
    assert lights.names == (("A",), (), ("A",), ("A", "B"), ("B",), ())


@given(st.lists(st.tuples(st.integers(0, 40), st.sampled_from("abc")), max_size=20))
def test_lights_are_those_of_the_last_half_second(seen):
    lights = scene._lights([k / 8 for k, _ in seen], [name for _, name in seen])
    assert np.all(np.diff(lights.t) > 0.0)
    for k in range(45):
        at = k / 8 + 1 / 16  # between the stamps
        i = np.searchsorted(lights.t, at) - 1
        lit = set(lights.names[i]) if i >= 0 else set()
        assert lit == {name for start, name in seen if start / 8 <= at < start / 8 + scene.LIT_FOR}


def test_an_ellipse_holds_95_percent():
    covariance = np.array(((0.04, 0.03), (0.03, 0.09)))
    (outline,) = ellipses(np.array([(1.0, 2.0)]), covariance[None], scene.SCALE_95)
    offsets = outline - (1.0, 2.0)
    distance = np.einsum("ki,ij,kj->k", offsets, np.linalg.inv(covariance), offsets)
    assert np.allclose(distance, 5.991, atol=1e-3)  # of chi squared with two degrees of freedom
    assert np.allclose(outline[0], outline[-1])


def test_pictures_become_jpegs(log):
    pictures = list(pictures_of.images(log))
    assert [t for t, _ in pictures] == [0.5, 1.5, 2.5]
    for i, (_, content) in enumerate(pictures):
        picture = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape == (24, 32, 3)
        assert abs(picture.astype(int) - 80 * i).max() <= 2
    jpeg = log.streams["camera"].file[0].with_suffix(".jpg")
    jpeg.write_bytes(pictures[1][1])
    kept = replace(log, streams={"camera": ImageStream(np.zeros(1), [jpeg])})
    assert next(pictures_of.images(kept))[1] == pictures[1][1]


def test_a_path_is_cut_at_gaps():
    t = np.array((0.0, 0.1, 0.2, 5.0, 5.1, 9.0))
    poses = np.column_stack((t, t, t))
    assert [len(part) for part in scene.segments(Trajectory(t, poses))] == [3, 2]


def test_evo_reads_poses_of_kitti(log, tmp_path):
    _, times = write_trajectory(log.reference, tmp_path / "arc.kitti")
    path = file_interface.read_kitti_poses_file(str(tmp_path / "arc.kitti"))
    assert path.check()[0]
    assert np.allclose(path.positions_xyz[:, :2], log.reference.poses[:, :2], atol=1e-9)
    headings = [np.arctan2(pose[1, 0], pose[0, 0]) for pose in path.poses_se3]
    assert np.allclose(headings, log.reference.poses[:, 2], atol=1e-9)
    assert times == tmp_path / "arc.times.txt"
    assert np.allclose(np.loadtxt(times), log.reference.t, atol=1e-9)


def test_poses_in_space(tmp_path):
    turns = Rotation.from_rotvec([(0.1, 0.2, 0.3), (0.0, -0.5, 1.0)]).as_matrix()
    positions = np.array(((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)))
    path = PosePath("path", positions, turns, np.array((0, 10**9)))
    _, times = write_trajectory(path, tmp_path / "space.kitti")
    poses = read_matrices(tmp_path / "space.kitti")
    assert np.allclose(poses[:, :, :3], turns, atol=1e-11)
    assert np.array_equal(poses[:, :, 3], positions)
    assert np.loadtxt(times).tolist() == [0.0, 1.0]

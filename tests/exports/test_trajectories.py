"""Trajectories as other programs read them: evo does as they are."""

import numpy as np
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from factorgraph_loc.exports.trajectories import write_trajectory
from factorgraph_loc.io.readers.pose_file import read_matrices
from factorgraph_loc.model.pose_path import PosePath


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

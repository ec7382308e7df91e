"""Rigs, maps and trajectories as files, and trajectories as what other programs take."""

from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

import factorgraph_loc as fgloc

T0 = 1_700_000_000 * 10**9
RNG = np.random.default_rng(8)
T = np.cumsum(RNG.uniform(0.05, 0.2, 30)).round(9)
FLAT = fgloc.Trajectory(T, RNG.uniform(-3.0, 3.0, (30, 3)))
TURNS = Rotation.random(30, random_state=1).as_matrix()
SPACE = fgloc.PosePath("space", RNG.uniform(-3.0, 3.0, (30, 3)), TURNS, np.rint(T * 1e9).astype(np.int64) + T0)
BOTH = pytest.mark.parametrize("trajectory", [FLAT, SPACE], ids=["floor", "space"])


def of(kind, path):
    """A path as a trajectory of its kind."""
    if kind is fgloc.Trajectory:
        return fgloc.Trajectory.of(path, T0)
    path.stamps()
    return path


def require_alike(found, trajectory, atol=1e-8):
    assert type(found) is type(trajectory)
    if isinstance(found, fgloc.Trajectory):
        assert found.t == pytest.approx(trajectory.t, abs=1e-6)
        assert found.poses == pytest.approx(trajectory.poses, abs=atol)
    else:
        np.testing.assert_allclose(found.t_ns - T0, trajectory.t_ns - T0, rtol=0.0, atol=1000)
        assert found.positions == pytest.approx(trajectory.positions, abs=atol)
        assert found.rotations == pytest.approx(trajectory.rotations, abs=atol)


@BOTH
def test_a_trajectory_comes_back_from_its_file(tmp_path, trajectory):
    fgloc.write_trajectory(trajectory, tmp_path / "poses.tum", T0)
    require_alike(of(type(trajectory), fgloc.read_trajectory(tmp_path / "poses.tum")), trajectory)
    fgloc.write_trajectory(trajectory, tmp_path / "poses.kitti")
    assert (tmp_path / "poses.times.txt").is_file()
    with pytest.raises(fgloc.InputError, match=r"poses.kitti: has poses without times, expected poses with times"):
        of(type(trajectory), fgloc.read_trajectory(tmp_path / "poses.kitti"))


def test_a_floor_is_no_staircase(tmp_path):
    fgloc.write_trajectory(SPACE, tmp_path / "poses.tum")
    with pytest.raises(fgloc.InputError, match="the height of poses varies by"):
        fgloc.Trajectory.of(fgloc.read_trajectory(tmp_path / "poses.tum"))


@BOTH
def test_a_trajectory_comes_back_from_an_array_and_a_table(trajectory):
    kind = type(trajectory)
    require_alike(kind.from_numpy(trajectory.to_numpy()), trajectory)
    table = trajectory.to_polars()
    assert len(table) == 30
    require_alike(kind.from_polars(table.with_columns(note=pl.lit("ours"))), trajectory)
    with pytest.raises(
        fgloc.InputError, match=r"the array has the shape \(30, 2\), expected \(N, [48]\): a row for each"
    ):
        kind.from_numpy(trajectory.to_numpy()[:, :2])
    with pytest.raises(fgloc.InputError, match=r"the array: pose 2 has the time .* s, expected a time after that"):
        kind.from_numpy(trajectory.to_numpy()[::-1])
    with pytest.raises(fgloc.InputError, match="the table has no column x, expected t, x, y"):
        kind.from_polars(table.drop("x"))
    with pytest.raises(fgloc.InputError, match="column y has values that are not numbers"):
        kind.from_polars(table.with_columns(y=pl.lit("left")))


def test_a_table_keeps_covariances():
    half = RNG.normal(size=(30, 3, 3))
    sure = fgloc.Trajectory(FLAT.t, FLAT.poses, half @ half.transpose(0, 2, 1))
    table = sure.to_polars()
    assert table.columns == ["t", "x", "y", "heading", "cov_xx", "cov_xy", "cov_xh", "cov_yy", "cov_yh", "cov_hh"]
    assert fgloc.Trajectory.from_polars(table).covariances == pytest.approx(sure.covariances, abs=0.0)
    with pytest.raises(fgloc.InputError, match="the table has no column cov_xy, expected all or none of cov_xx"):
        fgloc.Trajectory.from_polars(table.drop("cov_xy"))


@BOTH
def test_evo_takes_and_gives_a_trajectory(trajectory):
    evo = pytest.importorskip("evo.core.trajectory")
    made = fgloc.to_evo(trajectory, T0)
    assert isinstance(made, evo.PoseTrajectory3D)
    assert made.check()[0]
    require_alike(of(type(trajectory), fgloc.from_evo(made)), trajectory)
    alone = evo.PosePath3D(made.positions_xyz, made.orientations_quat_wxyz)
    with pytest.raises(fgloc.InputError, match="the trajectory of evo: has poses without times"):
        of(type(trajectory), fgloc.from_evo(alone))
    with pytest.raises(fgloc.InputError, match="expected a trajectory of evo"):
        fgloc.from_evo([1, 2])


@BOTH
def test_ros_takes_and_gives_a_trajectory(trajectory):
    typesys = pytest.importorskip("rosbags.typesys")
    path = fgloc.to_ros(trajectory, "hall", T0)
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    again = store.deserialize_cdr(store.serialize_cdr(path, "nav_msgs/msg/Path"), "nav_msgs/msg/Path")
    assert {pose.header.frame_id for pose in (again, *again.poses)} == {"hall"}
    require_alike(of(type(trajectory), fgloc.from_ros(again)), trajectory)
    require_alike(of(type(trajectory), fgloc.from_ros(again.poses)), trajectory)


def stamped(i, **content):
    return SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(sec=1_700_000_000 + i, nanosec=5)), **content)


def test_every_kind_of_message_has_a_pose():
    place = SimpleNamespace(x=1.0, y=2.0, z=0.0)
    turn = SimpleNamespace(x=0.0, y=0.0, z=np.sin(0.25), w=np.cos(0.25))
    pose = SimpleNamespace(position=place, orientation=turn)
    messages = [
        stamped(1, pose=pose),
        stamped(2, pose=SimpleNamespace(pose=pose, covariance=np.zeros(36))),
        stamped(3, transform=SimpleNamespace(translation=place, rotation=turn)),
    ]
    found = fgloc.Trajectory.of(fgloc.from_ros(messages), T0)
    assert found.poses == pytest.approx(np.tile((1.0, 2.0, 0.5), (3, 1)))
    assert found.t.tolist() == [1.000000005, 2.000000005, 3.000000005]
    points = fgloc.Trajectory.of(fgloc.from_ros([stamped(1, point=place)]))
    assert not points.has_heading
    with pytest.raises(fgloc.InputError, match="message 2 is of type SimpleNamespace, expected PoseStamped"):
        fgloc.from_ros([messages[0], stamped(2)])
    with pytest.raises(
        fgloc.InputError, match="the messages: pose 2 has the time 1700000001000000005 ns, expected a time"
    ):
        fgloc.Trajectory.of(fgloc.from_ros([messages[0], messages[0]]))
    with pytest.raises(fgloc.InputError, match="contains no poses"):
        fgloc.from_ros([])

"""Trajectories by name: formats of files, topics and frames of bags, results and logs."""

import math

import numpy as np
import pytest
from pose_files import T0, wander, write
from refusal import refusal
from rosbag_drive import COUNT, MS, add_frames, transform
from rosbag_drive import T0 as BAG_T0

from factorgraph_loc import InputError, read_trajectory


@pytest.fixture(scope="module")
def poses():
    return wander(1)[0]


@pytest.mark.parametrize("suffix", [".tum", ".csv", ".kitti"])
def test_the_first_row_tells_the_format(tmp_path, poses, suffix):
    found = read_trajectory(write(tmp_path / f"poses{suffix}", poses))
    np.testing.assert_allclose(found.positions, poses[1], atol=1e-8)
    assert (found.t_ns is None) == (suffix == ".kitti")
    if found.t_ns is not None:
        assert found.t_ns[:2].tolist() == [int(T0) * 10**9, int(T0) * 10**9 + 100 * MS]


TUM = "1 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.txt", "", "contains no poses, expected at least one row"),
        (
            "a.txt",
            "1 2 3\n",
            ":1: row is '1 2 3', expected 8 values (TUM: t x y z qx qy qz qw), 12 (KITTI), or 8 or more with",
        ),
        ("a.kitti", "1 0 0 0 0 1 0 0 0 0 2 0\n", ":1: rotation is "),
    ],
)
def test_bad_files_are_refused_in_a_line(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    refusal(lambda: read_trajectory(tmp_path / name), message)


@pytest.mark.parametrize(("unit", "per_second"), [("ns", 10**9), ("us", 10**6), ("ms", 10**3)])
def test_stamps_are_read_in_the_unit_that_their_size_shows(tmp_path, unit, per_second):
    stamps = [1_403_715_529 * per_second, 1_403_715_530 * per_second]
    (tmp_path / "a.tum").write_text("".join(f"{stamp} 0 0 0 0 0 0 1\n" for stamp in stamps))
    found = read_trajectory(tmp_path / "a.tum")
    assert found.t_ns.tolist() == [1_403_715_529 * 10**9, 1_403_715_530 * 10**9]
    assert found.warnings[0].fields["unit"] == unit


def test_rows_of_one_stamp_give_a_warning(tmp_path):
    (tmp_path / "a.tum").write_text(TUM + "1 5 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    found = read_trajectory(tmp_path / "a.tum")
    assert found.positions[:, 0].tolist() == [5.0, 0.0]
    assert "1 rows have the timestamp of the row after them and are skipped" in str(found.warnings[0])


def test_a_topic_of_a_bag(maker):
    for i in range(COUNT):
        t = BAG_T0 + 100 * MS * i
        maker.stamped("/mocap", t, "geometry_msgs/msg/PoseStamped", pose=maker.pose(0.1 * i, 1.0, 0.2, 0.5))
        maker.stamped(
            "/gnss",
            t,
            "geometry_msgs/msg/PointStamped",
            point=maker.make("geometry_msgs/msg/Point", x=0.1 * i, y=2.0, z=0.0),
        )
    maker.writer.close()
    found = read_trajectory(f"{maker.path}:/mocap")
    np.testing.assert_allclose(found.positions, [(0.1 * i, 1.0, 0.5) for i in range(COUNT)])
    assert found.t_ns.tolist() == [BAG_T0 + 100 * MS * i for i in range(COUNT)]
    np.testing.assert_allclose(found.rotations[0, 1, 0], math.sin(0.2))
    assert not read_trajectory(f"{maker.path}:/gnss").has_rotations
    assert len(read_trajectory(f"{maker.path}:/odom")) == COUNT
    for source, message in (
        (f"{maker.path}", ":TOPIC with one of its topics of poses: /gnss, /mocap, /odom"),
        (f"{maker.path}:/mocup", "has no topic '/mocup': did you mean /mocap?"),
    ):
        with pytest.raises(InputError, match=message):
            read_trajectory(source)


def test_a_frame_in_a_frame(maker):
    for i in range(COUNT):
        t = BAG_T0 + 100 * MS * i
        add_frames(maker, "/tf", t, transform(maker, t, "map", "odom", (5.0, 0.0, 0.0), heading=math.pi / 2))
        add_frames(maker, "/tf", t, transform(maker, t, "odom", "base_link", (0.1 * i, 0.0, 0.4)))
    add_frames(maker, "/tf_static", BAG_T0, transform(maker, BAG_T0, "base_link", "camera", (0.0, 0.0, 1.0)))
    maker.writer.close()
    found = read_trajectory(f"{maker.path}:/tf:map.camera")
    np.testing.assert_allclose(found.positions, [(5.0, 0.1 * i, 1.4) for i in range(COUNT)], atol=1e-12)
    assert found.t_ns.tolist() == [BAG_T0 + 100 * MS * i for i in range(COUNT)]
    for frames, message in (
        ("", "/tf holds transforms, expected two frames as well, such as .*:/tf:map.base_link"),
        (":map.base", "no transforms connect base to map: there is no frame 'base'"),
        (":map.map", "map does not move in map"),
    ):
        with pytest.raises(InputError, match=message):
            read_trajectory(f"{maker.path}:/tf{frames}")


def test_a_log_stands_for_its_reference(native):
    found = read_trajectory(native)
    assert found.t_ns.tolist() == [10**9, 1_500_000_000]
    (native / "reference.tum").unlink()
    with pytest.raises(InputError, match="is a log without a reference"):
        read_trajectory(native)

"""A file of poses alone as a log: its reference, or its odometry."""

import numpy as np
import pytest
from pose_files import T0, wander, write

from factorgraph_loc import InputError, run, write_native
from factorgraph_loc.evaluation.inspect import inspect


@pytest.mark.parametrize("suffix", [".tum", ".csv"])
def test_a_file_of_poses_is_a_reference(tmp_path, one, suffix):
    t, positions, quaternions = wander(2, flat=True)[0]
    log = one(write(tmp_path / f"truth{suffix}", (t, positions, quaternions)))
    assert (log.name, log.t0_ns, dict(log.streams), log.rig.sensors) == ("truth", round(T0 * 1e9), {}, ())
    np.testing.assert_allclose(log.reference.poses[:, :2], positions[:, :2], atol=1e-8)
    assert log.span() == pytest.approx((0.0, 9.9))
    found = inspect(log)
    assert (found.reference.rows, found.problems) == (100, ())
    with pytest.raises(InputError, match="truth: has no measurements, which a log needs"):
        write_native(log, tmp_path / "log")
    assert not (tmp_path / "log").exists()
    with pytest.raises(
        InputError, match="truth: is a trajectory without measurements, expected a log; as odometry: --reader"
    ):
        run(log, "ekf")


def test_poses_that_rise_or_tilt_are_seen_from_above(tmp_path, one, refused):
    t, positions, quaternions = wander(2)[0]
    low = positions * (1.0, 1.0, 0.5 / np.ptp(positions[:, 2]))
    log = one(write(tmp_path / "truth.tum", (t, low, quaternions)))
    np.testing.assert_allclose(log.reference.poses[:, :2], positions[:, :2], atol=1e-8)
    assert "poses vary in height by 0.50 m and tilt by up to" in log.warnings[0]
    high = write(tmp_path / "high.tum", (t, 20.0 * low, quaternions))
    refused(high, "high.tum: the height of poses varies by 10.0 m, expected a robot on a floor")
    assert one(high, options={"axes": "body"}, reader="trajectory").reference is not None


def test_poses_of_kitti_are_those_of_a_camera(tmp_path, one):
    t, positions, quaternions = wander(2, flat=True)[0]
    path = write(tmp_path / "truth.kitti", (t, positions, quaternions))
    log = one(path)
    assert "has no stamps, and is taken for 10 poses a second" in log.warnings[0]
    assert log.span() == pytest.approx((0.0, 9.9))
    np.testing.assert_allclose(log.reference.poses[:, 0], positions[:, 2], atol=1e-8)  # the camera looks down
    (tmp_path / "slow.txt").write_text("".join(f"{2.0 * i}\n" for i in range(100)))
    options = {"axes": "body", "times": "slow.txt"}
    slow = one(path, reader="trajectory", options=options)
    assert slow.span() == (0.0, 198.0)
    np.testing.assert_allclose(slow.reference.poses[:, :2], positions[:, :2], atol=1e-8)
    (tmp_path / "truth.times.txt").write_text((tmp_path / "slow.txt").read_text())
    exported = one(path)  # as `fgloc export` writes it
    assert exported.warnings == ()
    np.testing.assert_array_equal(exported.reference.poses, slow.reference.poses)


def test_as_odometry(tmp_path, one):
    t, positions, quaternions = wander(2, flat=True)[0]
    path = write(tmp_path / "wheels.tum", (t, positions, quaternions))
    log = one(path, reader="trajectory", options={"use": "odometry"})
    assert log.reference is None
    final = run(log, "dead_reckoning").result.final
    assert np.linalg.norm(final.poses[-1, :2]) == pytest.approx(np.linalg.norm(positions[-1] - positions[0]), abs=1e-6)


def test_bad_options_and_files_are_refused(tmp_path, refused):
    path = write(tmp_path / "truth.tum", wander(2)[0])
    refused(path, "has stamps of its own, expected no times", reader="trajectory", options={"times": "a.txt"})
    refused(tmp_path, "is not a file, expected one with poses", reader="trajectory")
    few = write(tmp_path / "few.kitti", wander(2)[0])
    (tmp_path / "few.times.txt").write_text("1.0\n")
    refused(few, "few.times.txt: number of rows is 1, expected at least 100, one for each pose of few.kitti")
    (tmp_path / "a.csv").write_text("t,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n")
    refused(tmp_path / "a.csv", "is a table: describe its columns in a manifest")
    (tmp_path / "a.txt").write_text("hello\n")
    refused(tmp_path / "a.txt", "is not a manifest (.toml); name the reader of this format")


def test_further_columns_are_named(tmp_path, one):
    path = tmp_path / "truth.csv"
    rows = "".join(f"{10**9 * i},{i},0,0,1,0,0,0,0.1\n" for i in (1, 2))
    path.write_text(rows)
    assert one(path).metadata["not read"] == "truth.csv: column 9"
    path.write_text(f"#timestamp, x, y, z, qw, qx, qy, qz, v_x [m s^-1]\n{rows}")
    assert one(path).metadata["not read"] == "truth.csv: v_x [m s^-1]"

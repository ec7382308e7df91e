"""The conversion of recordings to logs in the native format."""

import math

import numpy as np
import pytest
from scipy.io import savemat
from scripts_here import run_script

from factorgraph_loc.io.readers import read_log

T0 = 1_673_511_856_000_000  # us
TAGS = "epc,label,x_m,y_m,z_m,facing_deg\nE-1,A1,1.0,-2.0,1.5,90\nE-2,A2,3.0,-1.0,0.5,-90\n"


def a_read(us, epc="E-1", phase="90"):
    return f"1 {epc} 1 920.625 {phase} -60.5 {T0 + us + 5_000_000} {T0 + us}\n"


@pytest.fixture
def aisle(tmp_path):
    """One second of poses; a round of each antenna, one of the third before the poses and one across their end."""
    run = tmp_path / "rfid_aisle" / "run4"
    run.mkdir(parents=True)
    (tmp_path / "rfid_aisle" / "tags.csv").write_text(TAGS)
    poses = [f"{0.001 * k:.6f} 0.0 0.1 {T0 / 1e6 + 0.005 * k:.6f}" for k in range(201)]
    (run / "reference_pose.txt").write_text("\n".join(poses) + "\n")
    (run / "first.txt").write_text(
        a_read(130_000, "E-2", "180") + a_read(100_000) + a_read(990_000) + a_read(1_010_000)
    )
    (run / "second.txt").write_text(a_read(140_000) + a_read(190_000) + a_read(240_001))
    (run / "third.txt").write_text(a_read(-20_000) + a_read(400_000))
    return tmp_path


def test_a_run_of_the_aisle(aisle, tmp_path, capsys):
    assert run_script("convert", "rfid-aisle-run4", "--data-root", aisle, "-o", tmp_path / "logs") == 0
    assert "3 of 9 reads are outside of the reference" in capsys.readouterr().err
    log = read_log(tmp_path / "logs/rfid-aisle-run4")
    assert (log.name, log.t0_ns, log.rig.name) == ("rfid-aisle-run4", T0 * 1000, "rfid-aisle")
    reads = log.streams["rfid"]
    assert reads.antenna == ["first", "first", "second", "second", "second", "third"]
    assert reads.epc == ["E-1", "E-2", "E-1", "E-1", "E-1", "E-1"]
    assert reads.round.tolist() == [0, 0, 1, 1, 2, 3]
    # a round is over with another antenna's read, or after 50 ms
    np.testing.assert_allclose(reads.t, (0.14, 0.14, 0.24, 0.24, 0.290001, 0.45))
    np.testing.assert_allclose(reads.age, (0.04, 0.01, 0.1, 0.05, 0.05, 0.05))
    np.testing.assert_allclose(reads.phase[:2], (math.pi / 2, math.pi))
    assert (reads.rssi[0], reads.frequency[0]) == (-60.5, 920.625e6)
    tag = log.world.tags["E-2"]
    assert (tag.x, tag.y, tag.z, tag.facing) == (3.0, -1.0, 0.5, -math.pi / 2)
    assert np.diff(log.reference.t).max() <= 0.1
    assert log.streams["odometry"].t[-1] == pytest.approx(1.0)
    assert "simulated" in log.metadata["odometry"]


def test_the_seed_changes_the_odometry_only(aisle, tmp_path):
    logs = []
    for seed in (0, 1):
        options = ("--data-root", aisle, "--odometry-seed", seed, "-o", tmp_path / f"seed{seed}")
        run_script("convert", "rfid-aisle-run4", *options)
        logs.append(read_log(tmp_path / f"seed{seed}/rfid-aisle-run4"))
    first, second = logs
    assert np.any(first.streams["odometry"].dx != second.streams["odometry"].dx)
    np.testing.assert_array_equal(first.streams["rfid"].t, second.streams["rfid"].t)
    assert "seed 1" in second.metadata["odometry"]


def test_woods(tmp_path):
    """Landmark 1 is seen at 0.5 m and landmark 17 at 2 m in the first of three rows."""
    r, column = np.zeros((3, 17)), np.zeros((3, 1))
    r[0, 0], r[0, 16] = 0.5, 2.0
    fields = {"t": np.array([[0.0], [0.1], [0.2]]), "v": column + 0.25, "om": column, "r": r, "b": np.sign(r) * 4.0}
    truth = {"x_true": column, "y_true": column, "th_true": column + 4.0, "true_valid": np.array([[1], [0], [1]])}
    (tmp_path / "utias").mkdir()
    savemat(tmp_path / "utias/dataset2.mat", {**fields, **truth, "l": np.arange(34.0).reshape(17, 2)})
    run_script("convert", "woods-r2", "woods-r5", "--data-root", tmp_path, "-o", tmp_path)
    for name, seen in (("woods-r2", ["1"]), ("woods-r5", ["1", "17"])):
        log = read_log(tmp_path / name)
        assert (log.name, log.rig.name) == (name, "woods")
        assert list(log.streams["bearing_range"].landmark) == seen
        np.testing.assert_allclose(log.streams["bearing_range"].bearing, 4.0 - 2 * np.pi)
    np.testing.assert_array_equal(log.reference.t, (0.0, 0.2))  # the gap stays
    assert log.reference.poses[0, 2] == pytest.approx(4.0 - 2 * np.pi)
    assert log.world.position("2").tolist() == [2.0, 3.0]


@pytest.mark.parametrize(("name", "missing"), [("woods-r5", "dataset2.mat"), ("rfid-aisle-run13", "rfid_aisle")])
def test_a_missing_file_is_named(name, missing, tmp_path):
    with pytest.raises(SystemExit, match=missing):
        run_script("convert", name, "--data-root", tmp_path, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()

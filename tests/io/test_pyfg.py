import numpy as np
import pytest
from sound_files import PYFG


@pytest.fixture
def write(tmp_path):
    def write(text):
        (tmp_path / "small.pyfg").write_text(text)
        return tmp_path / "small.pyfg"

    return write


def test_pyfg(write, one):
    log = one(write(PYFG))
    odometry, ranges = log.streams["odometry"], log.streams["bearing_range"]
    assert (log.name, log.t0_ns, log.warnings) == ("small", 10_000_000_000, ())
    np.testing.assert_allclose(odometry.t, (0.0, 0.5, 1.0))
    np.testing.assert_allclose(odometry.dx, (0.0, 1.0, 0.0))
    np.testing.assert_allclose(odometry.dtheta, (0.0, 0.0, 7.0))
    np.testing.assert_allclose(ranges.t, (0.0, 0.5))  # those of their poses, in this order
    np.testing.assert_allclose(ranges.range, (3.9, 3.1))
    assert np.isnan(ranges.bearing).all()
    np.testing.assert_allclose(log.world.position("L0"), (5.0, 2.0))
    np.testing.assert_allclose(log.reference.poses[2], (2.0, 2.0, 7.0 - 2.0 * np.pi))


def test_the_noise_is_that_of_the_file(write, one):
    rig = one(write(PYFG)).rig
    noise = rig.odometry.noise
    assert noise.along.per_time == pytest.approx(0.2)
    assert noise.lateral.per_time == pytest.approx(0.1)
    assert noise.heading.per_time == pytest.approx(0.04)
    assert noise.heading.per_rotation == 0.0
    assert rig.bearing_range.range_sigma == pytest.approx(0.3)


def test_different_variances_and_ranges_of_zero_are_warnings(write, one):
    text = PYFG.replace("3.1 0.09", "0.0 0.36")
    log = one(write(text))
    assert len(log.streams["bearing_range"].t) == 1
    assert "variance differs between rows, 0.09 to 0.36: the rig has the median 0.225" in " ".join(
        map(str, log.warnings)
    )
    assert "range is 0: 1 ranges that are not above 0 are skipped" in " ".join(map(str, log.warnings))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("VERTEX_XY L0", "VERTEX_XYZ L0", ":5: row is VERTEX_XYZ, expected one of VERTEX_SE2, VERTEX_XY"),
        ("VERTEX_SE2 11.0 A2", "VERTEX_SE2 11.0 B2", ":4: pose is B2, expected poses of one robot, A"),
        ("VERTEX_SE2 11.0 A2", "VERTEX_SE2 11.0 A1", ":4: pose is A1, expected a name that no earlier pose has"),
        ("A1 A2 0.0", "A0 A2 0.0", ":7: EDGE_SE2 is A0 A2, expected A1 A2: motions from each pose to the next"),
        ("11.0 A1 A2 0.0", "11.0 A1 A2 nan", ":7: x is nan, expected a finite number"),
        ("VERTEX_XY L0 5.0", "VERTEX_XY L0 five", ":5: x is five, expected a number"),
        ("A1 L0 3.1", "A1 A2 3.1", ":8: EDGE_RANGE to is A2, expected a landmark"),
        ("A1 L0 3.1", "A7 L0 3.1", ":8: EDGE_RANGE from is A7, expected a pose"),
        ("3.1 0.09", "3.1", ":8: EDGE_RANGE is 10.6 A1 L0 3.1, expected t POSE LANDMARK range variance"),
        ("3.1 0.09", "3.1 0.0", ":8: variance is 0.0, expected a variance above 0"),
        ("VERTEX_SE2 11.0", "VERTEX_SE2 1.0", "expected a timestamp not before that of the previous row"),
        ("EDGE_SE2 11.0 A1 A2 0.0 0.0 7.0 0.02 0.0 0.0 0.005 0.0 0.0008\n", "", "has no EDGE_SE2 A1 A2"),
    ],
)
def test_what_is_not_read_names_its_row(write, refused, old, new, message):
    assert old in PYFG
    assert message in refused(write(PYFG.replace(old, new))).replace("'", "")


def test_a_file_without_poses(write, refused):
    assert "has 0 rows VERTEX_SE2, expected two or more poses" in refused(write("VERTEX_XY L0 5.0 2.0\n"))

"""The reader of the Plaza logs, which are there wherever gtsam is."""

import numpy as np
import pytest
from scipy.io import savemat

from factorgraph_loc.files import bounded
from factorgraph_loc.io.readers import load


def plaza(**changes):
    """A tiny Plaza file's fields; ``changes`` replace them, None leaves one out."""
    fields = {
        "DR": np.array([[10.1, 0.5, 0.0], [10.2, 0.5, 0.1]]),
        "TD": np.array([[10.05, 2, 1, 5.0], [10.15, 2, 6, 7.0]]),
        "GT": np.array([[10.0, 0, 0, 0], [10.1, 0.5, 0, 0], [10.2, 1, 0, 0.1]]),
        "TL": np.array([[1.0, 3, 4], [6, -3, 4]]),
    }
    return {name: value for name, value in {**fields, **changes}.items() if value is not None}


@pytest.fixture
def read_plaza(tmp_path, one):
    def call(run=1, **changes):
        savemat(tmp_path / "small.mat", plaza(**changes))
        return one(tmp_path / "small.mat", reader="plaza", options={"run": run})

    return call


def test_plaza(read_plaza):
    log = read_plaza()
    odometry, ranges = log.streams["odometry"], log.streams["bearing_range"]
    np.testing.assert_array_equal(odometry.t, (0.0, 0.1, 0.2))  # led by a row without motion
    np.testing.assert_array_equal(odometry.dx, (0.0, 0.5, 0.5))
    np.testing.assert_array_equal(odometry.dtheta, (0.0, 0.0, 0.1))
    assert ranges.landmark == ["1", "6"]
    assert np.isnan(ranges.bearing).all()
    assert list(log.world.landmarks) == ["1", "6"]
    assert not log.reference.has_heading


def test_plaza_2_has_its_heading_turned(read_plaza):
    log = read_plaza(run=2)
    assert log.reference.has_heading
    assert log.reference.poses[1, 2] == pytest.approx(np.pi)


PLAZA_BAD = {
    "field missing": ({"DR": None}, "DR is missing"),
    "shape": ({"TL": np.zeros((2, 2))}, "TL has shape (2, 2)"),
    "negative range": ({"TD": np.array([[10.0, 2, 1, -1]])}, "TD:1: range is -1.0"),
    "no rows": ({"DR": np.zeros((0, 3))}, "DR"),
}


@pytest.mark.parametrize(("changes", "fragment"), PLAZA_BAD.values(), ids=list(PLAZA_BAD))
def test_bad_plaza(tmp_path, refused, changes, fragment):
    savemat(tmp_path / "small.mat", plaza(**changes))
    refused(tmp_path / "small.mat", "small.mat", fragment, reader="plaza", options={"run": 1})


def test_arrays_that_unpack_to_too_much_are_refused(tmp_path, refused, monkeypatch):
    savemat(tmp_path / "large.mat", plaza(DR=np.zeros((100_000, 3))), do_compression=True)
    monkeypatch.setattr(bounded, "DATA", 2**20)
    refused(tmp_path / "large.mat", "its size in bytes when unpacked is 2,400,", reader="plaza", options={"run": 1})


@pytest.mark.parametrize(("run", "rows", "ranges"), [(1, 9658, 3527), (2, 4091, 1816)])
def test_recorded_plaza(run, rows, ranges):
    (log,) = load(f"plaza{run}")
    assert log.rig.name == "plaza"
    assert len(log.streams["odometry"].t) == rows
    assert len(log.streams["bearing_range"].t) == ranges
    assert set(log.world.landmarks) == set(log.streams["bearing_range"].landmark)
    assert log.reference.has_heading == (run == 2)
    # a positive distance drives forward: the heading is that of the motion
    poses = log.reference.poses
    motion = poses[5:, :2] - poses[:-5, :2]
    ahead = np.column_stack((np.cos(poses[2:-3, 2]), np.sin(poses[2:-3, 2])))
    moving = np.hypot(*motion.T) > 0.5
    assert np.median(np.sum(motion * ahead, axis=1)[moving]) > 0.5

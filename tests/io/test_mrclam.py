"""MRCLAM folders: one robot's run, with what is left out and what is refused."""

import math

import numpy as np
import pytest

from factorgraph_loc.io.readers import load


@pytest.fixture
def read(one):
    return lambda folder, **kwargs: one(folder, reader="mrclam", **{"options": {"robot": "1"}, **kwargs})


@pytest.fixture
def refuse(refused):
    return lambda folder, *fragments: refused(folder, *fragments, reader="mrclam", options={"robot": 1})


def test_what_is_read(mrclam, read):
    log = read(mrclam)
    assert (log.name, log.rig.name, log.world.name) == ("set-robot1", "default", "mrclam")
    assert log.t0_ns == 1248444187_156_000_000
    np.testing.assert_array_equal(log.streams["odometry"].t, (0.0, 0.03, 0.041))
    np.testing.assert_array_equal(log.streams["odometry"].w, (-0.398, 0.0, 0.2))
    sightings = log.streams["bearing_range"]
    assert sightings.landmark == ["6", "7"]
    np.testing.assert_array_equal(sightings.t, (0.004, 0.004))
    np.testing.assert_array_equal(sightings.range, (3.787, 2.0))
    assert len(list(sightings.measurements(0.0))) == 1
    assert log.world.landmarks["6"].sigma == 0.0002
    np.testing.assert_array_equal(log.reference.t, (-0.056, 0.044))
    left_out, no_rig = map(str, log.warnings)
    assert "Robot1_Measurement.dat: 2 rows are skipped: their landmark is not listed in Barcodes.dat" in left_out
    assert "no rig is given" in no_rig


BAD = {
    "too late": ("Robot1_Measurement.dat", "2.0 63 1 0\n1.4 63 1 0\n", ":2: time", "at most 0.5 s older"),
    "half a barcode": (
        "Robot1_Measurement.dat",
        "2.0 63.5 1 0\n",
        "no row has a landmark that is listed in Barcodes.dat",
    ),
    "barcode twice": ("Barcodes.dat", "6 63\n7 63\n", "Barcodes.dat:2: 2 is '63'", "once"),
    "landmark twice": ("Landmark_Groundtruth.dat", "6 0 0 0 0\n6 1 1 0 0\n", ":2: landmark is '6'", "in row 1"),
}


@pytest.mark.parametrize(("name", "text", "fragments"), [(n, t, f) for n, t, *f in BAD.values()], ids=list(BAD))
def test_bad_input(mrclam, refuse, name, text, fragments):
    (mrclam / name).write_text(text)
    refuse(mrclam, name, *fragments)


@pytest.mark.parametrize(("robot", "rows", "sightings"), [(1, 61785, 1534), (3, 61150, 4348), (5, 60563, 4239)])
def test_recorded_logs(data_root, robot, rows, sightings):
    (log,) = load(f"mrclam6-robot{robot}", data_root=data_root)
    assert len(log.streams["odometry"].t) == rows
    assert len(log.streams["bearing_range"].t) == sightings
    assert (len(log.world.landmarks), log.rig.name) == (15, "mrclam")
    # a sighting is where the map says, but for the noise: names and frames are right
    stream = log.streams["bearing_range"]
    poses = log.reference.at(stream.t, max_gap=0.1)
    points = np.array([log.world.position(name) for name in stream.landmark])
    offset = points - poses[:, :2]
    bearing = np.arctan2(offset[:, 1], offset[:, 0]) - poses[:, 2] - stream.bearing
    assert np.nanmedian(np.abs(np.hypot(*offset.T) - stream.range)) < 0.2
    assert np.nanmedian(np.abs((bearing + math.pi) % (2 * math.pi) - math.pi)) < 0.03

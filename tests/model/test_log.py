"""The measurements of a log, in the order in which they arrived."""

from dataclasses import replace

import numpy as np
import pytest
from by_hand import reads

from factorgraph_loc import InputError, Rig, Trajectory, World, read_world
from factorgraph_loc.model.log import Log, StartPose, cut, join
from factorgraph_loc.model.measurement import Rows
from factorgraph_loc.sensors.landmarks.measurement import (
    BearingRange,
    BearingRangeSettings,
    BearingRangeStream,
    Landmark,
)
from factorgraph_loc.sensors.odometry.measurement import (
    IncrementOdometry,
    IncrementStream,
    VelocityOdometry,
    VelocityStream,
    YawRate,
    YawRateStream,
)


def column(*values):
    return np.array(values, dtype=float)


def sightings(*rows):
    t, names, ranges, bearings = zip(*rows, strict=True)
    return BearingRangeStream(column(*t), names, column(*ranges), column(*bearings))


def make_log(offset=0.0, **streams):
    settings = BearingRangeSettings(range_sigma=0.1, time_offset=offset)
    return Log(name="log", rig=Rig(bearing_range=settings), world=World(), streams=streams)


ODOMETRY = VelocityStream(column(0, 1, 2), column(1, 1, 1), column(0, 0, 0))


def test_rows_of_one_stamp_belong_together():
    stream = sightings((1, "A", 2, 0.5), (1, "B", 3, np.nan), (2, "A", 1, 0))
    first, second = stream.measurements(0.25)
    assert (first.t, first.landmarks) == (1.25, ("A", "B"))
    np.testing.assert_array_equal(first.range, (2, 3))
    np.testing.assert_array_equal(first.bearing, (0.5, np.nan))
    assert (second.t, second.landmarks) == (2.25, ("A",))


def test_increments_and_yaw_rates():
    (increment,) = IncrementStream(column(1), column(0.5), column(0.1), column(0.2)).measurements(0.5)
    assert increment == IncrementOdometry(1.5, 0.5, 0.1, 0.2)
    assert list(YawRateStream(column(1), column(0.3)).measurements(0.0)) == [YawRate(1.0, 0.3)]


def test_odometry_comes_first_at_equal_times():
    log = make_log(bearing_range=sightings((1, "A", 2, 0)), odometry=ODOMETRY, imu=YawRateStream(column(1), column(0)))
    kinds = [type(m) for m in log.measurements(("bearing_range", "imu", "odometry")) if m.t == 1.0]
    assert kinds == [VelocityOdometry, YawRate, BearingRange]


def test_only_the_sensors_that_are_asked_for():
    log = make_log(bearing_range=sightings((1, "A", 2, 0)), odometry=ODOMETRY)
    assert [type(m) for m in log.measurements(("bearing_range", "camera"))] == [BearingRange]


def test_the_offset_of_a_clock_changes_stamp_and_order():
    log = make_log(-0.5, bearing_range=sightings((1.25, "A", 2, 0)), odometry=ODOMETRY)
    assert [m.t for m in log.measurements(("odometry", "bearing_range"))] == [0.0, 0.75, 1.0, 2.0]


def test_a_late_measurement_keeps_its_stamp_and_its_place():
    late = sightings((1.5, "A", 2, 0), (0.5, "A", 3, 0))
    log = make_log(bearing_range=late, odometry=ODOMETRY)
    assert [m.t for m in log.measurements(("odometry", "bearing_range"))] == [0.0, 1.0, 1.5, 0.5, 2.0]


def each_of(rows):
    """The measurements that rows are."""
    return map(rows.kind, rows.times.tolist(), *(values.tolist() for values in rows.values))


def test_rows_of_odometry_that_follow_one_another_are_one_step():
    late = VelocityStream(column(0, 1, 2, 1.5, 3, 4, 5), column(1, 2, 3, 4, 5, 6, 7), column(0, 0, 0, 0, 1, 1, 1))
    seen = sightings((1, "A", 2, 0), (3.5, "B", 2, 0), (4, "B", 2, 0))
    turned = YawRateStream(column(0.5, 3.5), column(0.1, 0.2))
    for streams, steps in (
        ({"odometry": late, "bearing_range": seen}, [2, 1, 1, 1, 1, 1, 1, 1, 1]),
        ({"odometry": late, "imu": turned}, [1, 1, 2, 1, 1, 1, 2]),
        ({"imu": turned}, [1, 1]),
    ):
        log = make_log(**streams)
        found = list(log.steps(tuple(streams)))
        assert [m.count for m in found] == steps
        singly = [one for m in found for one in (each_of(m) if isinstance(m, Rows) else [m])]
        assert list(map(str, singly)) == list(map(str, log.measurements(tuple(streams))))


def drive(kind):
    """Ten seconds with all sensors, one late sighting, a reference and a start."""
    t = np.arange(100) * 0.1
    ones = np.ones(100)
    odometry = VelocityStream(t, ones, 0.1 * ones) if kind == "velocity" else IncrementStream(t, ones, 0 * ones, ones)
    log = make_log(
        odometry=odometry,
        imu=YawRateStream(t + 0.05, 0.1 * ones),
        bearing_range=sightings(
            (1, "A", 2, 0.5), (1, "B", 3, np.nan), (5.2, "A", 2, 0.1), (4.9, "B", 2, 0), (9, "A", 1, 0)
        ),
    )
    truth = Trajectory(t + 0.02, np.stack((t, t, 0 * t), axis=1), np.tile(np.eye(3), (100, 1, 1)))
    covariance = (0.04, -0.01, 0.09)
    world = World(landmarks={"A": Landmark(x=1, y=2, covariance=covariance), "B": Landmark(x=3, y=4, sigma=0.1)})
    start = StartPose(0.0, np.zeros(3), np.ones(3))
    return replace(log, name="drive", reference=truth, start=start, t0_ns=10**18, world=world)


@pytest.mark.parametrize("kind", ["velocity", "increments"])
def test_parts_of_a_log_joined_again_hold_what_it_held(kind):
    log = drive(kind)
    parts = cut(log, 0.0, 5.0), cut(log, 5.0, 10.0)
    assert [len(part.streams["odometry"].t) for part in parts] == [50, 50]
    assert [list(part.streams["bearing_range"].landmark) for part in parts] == [["A", "B", "B"], ["A", "A"]]
    assert parts[1].streams["imu"].t[0] == pytest.approx(5.05)
    assert [len(part.reference) for part in parts] == [50, 50]
    assert parts[0].start is parts[1].start is None
    again = join(*parts, gap=0.5)
    for name, stream in log.streams.items():
        assert len(again.streams[name].t) == len(stream.t)
    assert sorted(again.streams["bearing_range"].landmark) == sorted(log.streams["bearing_range"].landmark)
    # the last stamp of the first part is that of the gyro at 4.95 s, the first of the second that of the odometry at 5 s
    np.testing.assert_allclose(np.diff(again.streams["odometry"].t)[49], 4.95 + 0.5 - 4.9)
    np.testing.assert_allclose(np.diff(again.reference.t)[49], 4.95 + 0.5 + 0.02 - 4.92)
    np.testing.assert_array_equal(again.reference.poses, log.reference.poses)
    assert again.reference.covariances.shape == (100, 3, 3)
    assert (again.name, again.t0_ns) == ("drive+drive", log.t0_ns)


def test_a_kidnapped_robot_keeps_its_velocity_and_feels_no_increment():
    log = drive("increments")
    odometry = join(cut(log, 0.0, 5.0), cut(log, 2.0, 4.0)).streams["odometry"]
    assert len(odometry.t) == 70
    assert (odometry.dx == 0.0).nonzero()[0].tolist() == (odometry.dtheta == 0.0).nonzero()[0].tolist() == [50]
    log = drive("velocity")
    odometry = join(cut(log, 0.0, 5.0), cut(log, 2.0, 4.0)).streams["odometry"]
    assert (odometry.v == 1.0).all()


READS = reads(
    (1.0, 0, "left", "E1", 0.2),
    (1.0, 0, "left", "E2", 0.0),
    (1.0, 1, "right", "", 0.0),
    (1.0, 2, "left", "E1", 0.1),
    (2.0, 0, "right", "E1", 0.0),
    (3.0, 0, "left", "", 0.0),
)


def test_rounds_that_end_together_are_one_scan():
    first, second, third = READS.measurements(0.5)
    assert (first.t, first.antennas, first.tags) == (1.5, ("left", "right", "left"), ("E1", "E2", "E1"))
    assert first.antenna.tolist() == [0, 0, 2]
    np.testing.assert_array_equal(first.age, (0.2, 0.0, 0.1))
    assert (second.antennas, second.tags) == (("right",), ("E1",))
    assert (third.t, third.antennas, third.tags, third.rssi.shape) == (3.5, ("left",), (), (0,))


def test_reads_are_cut_and_joined_by_scans():
    log = make_log(odometry=ODOMETRY, rfid=READS)
    first, second = cut(log, 0.0, 1.5), cut(log, 1.5, 9.0)
    assert [len(list(part.measurements(("rfid",)))) for part in (first, second)] == [1, 2]
    again = list(join(second, first, gap=0.5).measurements(("rfid",)))
    # the second part ends at 3 s, the first begins with odometry at 0 s
    assert [scan.t for scan in again] == [2.0, 3.0, 4.5]
    assert [scan.tags for scan in again] == [("E1",), (), ("E1", "E2", "E1")]
    assert again[2].antennas == ("left", "right", "left")


def test_parts_that_are_none_and_logs_that_do_not_fit():
    log = drive("velocity")
    with pytest.raises(InputError, match=r"drive: has no measurements in 20 to 30 s, .* in 0 to 9\.95 s"):
        cut(log, 20.0, 30.0)
    assert cut(replace(log, reference=None), 2.0, np.inf).reference is None
    for other, message in (
        (replace(log, rig=Rig()), "differ in their rig"),
        (replace(log, world=World()), "differ in their map"),
        (drive("increments"), "a log with VelocityStream and one with IncrementStream"),
    ):
        with pytest.raises(InputError, match=message):
            join(log, other)
    with pytest.raises(InputError, match="gap between drive and drive is 0 s"):
        join(log, log, gap=0.0)


@pytest.mark.parametrize("covariance", [(1.0, 2.0, 1.0), (-1.0, 0.0, 1.0), (0.0, 0.1, 1.0)])
def test_a_landmark_takes_no_covariance_that_is_none(covariance, tmp_path):
    (tmp_path / "a.world.toml").write_text(f"[landmarks.A]\nx = 1\ny = 2\ncovariance = {list(covariance)}\n")
    with pytest.raises(InputError, match=r"landmarks.A.covariance is \[.*expected .* positive semi-definite"):
        read_world(tmp_path / "a.world.toml")

"""The measurements of a log, in the order in which they arrived."""

import numpy as np

from factorgraph_loc.log import BearingRangeStream, IncrementStream, Log, VelocityStream, YawRateStream
from factorgraph_loc.measurements import BearingRange, IncrementOdometry, VelocityOdometry, YawRate
from factorgraph_loc.rig import BearingRangeSettings, Rig
from factorgraph_loc.world import World


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


def test_streams_without_rows():
    empty = column()
    streams = (
        BearingRangeStream(empty, (), empty, empty),
        VelocityStream(empty, empty, empty),
        YawRateStream(empty, empty),
    )
    assert [list(stream.measurements(0.0)) for stream in streams] == [[], [], []]


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


def test_span():
    assert make_log(bearing_range=sightings((-1, "A", 2, 0)), odometry=ODOMETRY).span() == (-1.0, 2.0)
    assert make_log().span() == (0.0, 0.0)

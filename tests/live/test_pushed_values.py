"""Whatever stands in a measurement that is pushed: it is within its bounds, or refused in one line."""

import math
from dataclasses import fields, replace
from datetime import date
from decimal import Decimal

import numpy as np
import pytest
from by_hand import started
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import factorgraph_loc as fgloc
from factorgraph_loc import (
    BearingRange,
    CameraFrame,
    CameraImage,
    IncrementOdometry,
    InputError,
    Localizer,
    PixelSightings,
    RfidRead,
    RfidScan,
    Rig,
    VelocityOdometry,
    YawRate,
)
from factorgraph_loc.live.localizer import prior_of
from factorgraph_loc.sensors.camera.measurement import FEATURES
from factorgraph_loc.sensors.camera.measurement import PAIRS as PIXELS
from factorgraph_loc.sensors.landmarks.measurement import BEARING_RANGE
from factorgraph_loc.sensors.odometry.measurement import IMU, INCREMENTS, VELOCITIES
from factorgraph_loc.sensors.rfid.stream import READS, scan_of
from factorgraph_loc.sensors.tables import checked

ONE = np.ones(1)
SOUND = [
    VelocityOdometry(1.0, 0.5, 0.1),
    IncrementOdometry(1.0, 0.5, 0.0, 0.1),
    YawRate(1.0, 0.1),
    BearingRange(1.0, ("a",), ONE, ONE),
    RfidScan(1.0, ("left",), np.zeros(1, dtype=np.int64), ("e1",), ONE, -60.0 * ONE, ONE, 9e8 * ONE),
    PixelSightings(1.0, ("a",), np.ones((1, 2))),
    CameraFrame(1.0, "orb", np.ones((1, 2)), np.zeros((1, 32), dtype=np.uint8), np.zeros(1, dtype=np.int64)),
    CameraFrame(1.0, "sift", np.ones((1, 2)), np.ones((1, 128), dtype=np.float32), np.zeros(1, dtype=np.int64)),
]
COLUMNS = {
    VelocityOdometry: VELOCITIES.columns[1:],
    IncrementOdometry: INCREMENTS.columns[1:],
    YawRate: IMU.columns[1:],
    BearingRange: [column.measured for column in BEARING_RANGE.columns[2:]],
    RfidScan: READS.columns,
    PixelSightings: [PIXELS],
    CameraFrame: [FEATURES["pixels"]],
}
COLUMNS = {kind: {column.name: column for column in columns} for kind, columns in COLUMNS.items()}


class Odd:
    """Neither compares nor converts."""

    def __array__(self, *_args, **_kwargs):
        raise ValueError("no array")

    def __repr__(self):
        raise RuntimeError("no text")


ABSURD = [
    *(None, True, False, "", "1.0", "here", b"1", 1j, np.complex128(1.0), date(2026, 1, 1), Decimal("1.5"), {}, {1: 2}),
    *(10**400, -(10**400), 2**63, -(2**70), math.nan, math.inf, -math.inf, 1e300, -1e308, 1e-300, 5e-324, 4.7e9, 0, -1),
    *(5, 5.0, np.float32(2.0), np.int8(1), np.bool_(True), np.array(5), np.array("x"), np.array(None), np.array([])),
    *([], [1.0], [[1.0], [1.0, 2.0]], [10**400], [None], ["a"], ("a",), ["a", 1], [True], [[1.0, 2.0]], [[[1.0]]]),
    *(np.ones(1), np.ones(3), np.ones((1, 2)), np.full(1, 1e300), np.full((1, 2), np.nan), np.array([10**30])),
    *(np.array([1.0], dtype=object), np.array([None]), np.array([1j]), np.array(["1"]), np.ones(1, dtype="M8[s]")),
    *(Odd(), object(), int, lambda: 1.0, range(3), iter([1.0])),
]


def outcome(call):
    """What a call returns, or the line with which it refuses."""
    try:
        return call()
    except InputError as error:
        line = str(error)
    assert line
    assert "\n" not in line
    return line


@settings(max_examples=400, deadline=None, suppress_health_check=list(HealthCheck))
@given(m=st.sampled_from(SOUND), data=st.data())
def test_a_field_is_within_its_bounds_or_refused_in_one_line(m, data):
    names = [field.name for field in fields(m)]
    for name in data.draw(st.lists(st.sampled_from(names), min_size=1, max_size=2, unique=True)):
        m = replace(m, **{name: data.draw(st.sampled_from(ABSURD) | st.floats() | st.integers())})
    found = outcome(lambda: checked(m))
    if isinstance(found, str):
        assert type(m).__name__ in found
        return
    assert type(found.t) is float
    assert abs(found.t) <= 4.6e9
    for name, column in COLUMNS[type(m)].items():
        assert not column.outside(np.asarray(getattr(found, name))).any()


@pytest.mark.parametrize("m", SOUND, ids=lambda m: type(m).__name__)
def test_what_is_at_the_bounds_is_taken_as_it_is(m):
    for name, column in COLUMNS[type(m)].items():
        for value in (column.low, column.high):
            given_value = np.full(np.shape(getattr(m, name)), value)
            found = checked(replace(m, **{name: given_value if given_value.shape else value}))
            assert np.all(np.asarray(getattr(found, name)) == value)


@pytest.mark.parametrize("m", SOUND, ids=lambda m: type(m).__name__)
def test_what_is_beyond_the_bounds_is_refused_with_its_field(m):
    for name, column in COLUMNS[type(m)].items():
        for value in (np.nextafter(column.low, -np.inf), np.nextafter(column.high, np.inf)):
            given_value = np.full(np.shape(getattr(m, name)), value)
            with pytest.raises(InputError, match=rf"at 1.000 s: {name} is .*, expected a finite number"):
                checked(replace(m, **{name: given_value}))


@settings(max_examples=200, deadline=None)
@given(
    t=st.sampled_from([1.0, *ABSURD]),
    antennas=st.sampled_from([("left",), *ABSURD]),
    field=st.sampled_from([field.name for field in fields(RfidRead)]),
    value=st.sampled_from(ABSURD),
)
def test_reads_are_rounds_or_refused_in_one_line(t, antennas, field, value):
    read = replace(RfidRead("left", "e1"), **{field: value})
    for reads in ([read], value):
        outcome(lambda reads=reads: checked(scan_of(t, antennas, reads)))


@settings(max_examples=300, deadline=None)
@given(
    pose=st.sampled_from([(0.0, 0.0, 0.0), (1.0, 2.0, math.nan), (1e308, 0, 0), (0, 0, 1e300), (1e7, 0, 0), *ABSURD]),
    covariance=st.sampled_from(
        [None, np.eye(3), np.eye(2), 1e-30 * np.eye(3), 1e30 * np.eye(3), np.full((3, 3), np.inf), *ABSURD]
    ),
    t=st.sampled_from([None, 1.0, *ABSURD]),
)
def test_a_start_is_within_its_bounds_or_refused_in_one_line(pose, covariance, t):
    prior = outcome(lambda: prior_of(pose, covariance, t))
    if isinstance(prior, str):
        return
    assert np.all(np.abs(prior.pose[:2]) <= 1e7)
    size = 3 if prior.has_heading else 2
    assert np.all(np.linalg.eigvalsh(prior.covariance[:size, :size]) > 0.0)


def test_a_localizer_is_made_or_refused_in_one_line():
    for argument in ("rig", "world", "settings", "sensors", "history", "seed"):
        for value in ABSURD:
            options = {"rig": Rig(), argument: value, "estimator": "ekf"}
            outcome(lambda options=options: Localizer(**options))


def test_times_of_estimates_and_images():
    localizer = Localizer(Rig(), estimator="ekf")
    localizer.initialize((0.0, 0.0, 0.0))
    for value in ABSURD:
        outcome(lambda value=value: localizer.estimate(value))
        outcome(lambda value=value: localizer.push(CameraImage(value, np.zeros((4, 4), np.uint8))))


def test_descriptors_of_another_length_are_refused():
    log = fgloc.simulate("office", 3, changes={"drive": {"duration": 1.0}, "world": {"points": 4}})
    localizer = Localizer(log.rig, log.world, "ekf", sensors=("odometry", "camera"))
    localizer.initialize((1.0, 1.0, 0.0), t=0.0)
    whole = np.zeros(1, dtype=np.int64)
    for width, refused in ((32, False), (16, True), (0, True), (32, False)):
        frame = CameraFrame(1.0, "orb", np.ones((1, 2)), np.zeros((1, width), dtype=np.uint8), whole)
        if refused:
            with pytest.raises(InputError, match=rf"length of descriptors is {width}, expected 32 numbers each"):
                localizer.push(frame)
        else:
            localizer.push(frame)


@pytest.fixture(scope="module")
def log():
    """The rig and map of an office."""
    return fgloc.simulate("office", 3, changes={"drive": {"duration": 1.0}, "world": {"tags": 12, "landmarks": 6}})


def test_clocks_that_go_back_or_are_others_are_refused(log):
    localizer = started(log, "ekf")
    localizer.push(IncrementOdometry(5.0, 0.1, 0.0, 0.0))
    with pytest.raises(
        InputError, match=r"IncrementOdometry at 4.900 s: follows an increment at 5.000 s, expected increments in order"
    ):
        localizer.push(IncrementOdometry(4.9, 0.1, 0.0, 0.0))
    with pytest.raises(
        InputError, match=r"IncrementOdometry at 1700000000.000 s: is 1699999995 s ahead of all other timestamps"
    ):
        localizer.push(IncrementOdometry(1.7e9, 0.1, 0.0, 0.0))
    with pytest.raises(InputError, match=r"t is 1700000000.000 s, 1699999995 s ahead of all measurements"):
        localizer.estimate(1.7e9)
    with pytest.raises(InputError, match="t is nan"):
        localizer.estimate(math.nan)
    localizer.push(IncrementOdometry(5.1, 0.1, 0.0, 0.0))
    assert localizer.estimate().t == 5.1


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"pose": (1.0, 2.0)}, r"pose is \[1.0, 2.0\], expected finite x, y \[m\] and heading"),
        (
            {"pose": (0, 0, 0), "covariance": np.diag((1.0, 0.0, 1.0))},
            r"expected \(3, 3\), symmetric and positive definite",
        ),
        ({}, "ekf cannot start from an unknown pose with this rig and map: give a pose"),
    ],
)
def test_a_start_that_cannot_be_is_refused(log, given, message):
    localizer = fgloc.Localizer(log.rig, log.world, "ekf")
    with pytest.raises(InputError, match=message):
        localizer.initialize(**given)


def test_reads_of_an_antenna_that_did_not_listen_are_refused(log):
    localizer = started(log)
    with pytest.raises(InputError, match="antenna is 'left', expected one of the active antennas: front, back"):
        localizer.push(scan_of(1.0, ["front", "back"], [RfidRead("left", "e1")]))


def reads_of(antennas, reads):
    """The antenna and the tag of each round that read it, as estimators count them: once a round."""
    m = scan_of(1.0, antennas, reads)
    rounds = set(zip(m.antenna.tolist(), m.tags, strict=True))
    return sorted((m.antennas[k], tag) for k, tag in rounds)


def test_a_tag_that_is_read_twice_was_read_in_two_rounds():
    front, left = RfidRead("front", "e1"), RfidRead("left", "e1")
    twice = ["front", "left", "front"]
    assert reads_of(twice, [front, front]) == [("front", "e1")] * 2
    assert reads_of(twice, [front, left, front]) == [("front", "e1")] * 2 + [("left", "e1")]
    assert reads_of(twice, [front, RfidRead("front", "e2")]) == [("front", "e1"), ("front", "e2")]
    # more reads than rounds: no round can have read it more than once
    assert reads_of(twice, [front] * 5) == [("front", "e1")] * 2


def test_a_read_tells_its_round():
    first, last = RfidRead("front", "e1", t=0.9), RfidRead("front", "e1", t=0.8, round=0)
    m = scan_of(1.0, ["front", "left", "front"], [first, last])
    assert m.antenna.tolist() == [2, 0]
    # in the order of time, whatever the order of the rows
    m = scan_of(1.0, ["front", "front"], [RfidRead("front", "e1", t=0.9), RfidRead("front", "e1", t=0.5)])
    assert m.antenna.tolist() == [1, 0]
    told_twice = [RfidRead("front", "e1", round=1), RfidRead("front", "e1", round=1)]
    assert reads_of(["front", "front"], told_twice) == [("front", "e1")]


def test_reads_are_those_of_a_scan(log):
    antenna, tag = next(iter(log.rig.rfid.all_antennas())), next(iter(log.world.tags))
    nan = np.full(1, np.nan)
    one, other = (started(log, sensors=("odometry", "rfid")) for _ in range(2))
    for localizer in (one, other):
        localizer.push(IncrementOdometry(0.1, 0.0, 0.0, 0.0))
    one.push(scan_of(0.5, [antenna], [RfidRead(antenna, tag, t=0.4)]))
    other.push(RfidScan(0.5, (antenna,), np.zeros(1, dtype=np.int64), (tag,), np.array((0.5 - 0.4,)), nan, nan, nan))
    assert np.array_equal(one.estimate().pose, other.estimate().pose)

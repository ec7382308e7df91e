"""Whatever stands in a measurement that is pushed: it is within its bounds, or refused in one line."""

import math
from dataclasses import fields, replace
from datetime import date
from decimal import Decimal

import numpy as np
import pytest
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

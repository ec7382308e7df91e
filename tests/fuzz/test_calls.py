"""The localizer called in any order with any values, and each estimator on logs with faults: a sound result or one line."""

import math
from functools import cache
from itertools import cycle

import numpy as np
import pytest
import sound_files
from absurd_logs import FAULTS, require_sound, verdict, whole
from hypothesis import given
from hypothesis import strategies as st
from refusals import examples, taken_or_refused

import factorgraph_loc as fgloc

pytestmark = pytest.mark.filterwarnings("ignore")
ESTIMATORS = (
    *(("ekf", {}), ("ekf", {"landmarks": "unknown"}), ("ekf", {"max_delay": 0.0}), ("dead_reckoning", {})),
    *(("smoother", {}), ("smoother", {"lag": 1.0}), ("smoother", {"landmarks": "unknown"}), ("batch", {})),
    *(("particle_filter", {"particles": 30}), ("switching", {"particles": 30}), ("monoslam", {})),
)
SENSORS = ("odometry", "imu", "rfid", "bearing_range", "sightings", "rssi", "phase", "camera", "position")
ABSURD = (
    math.nan,
    math.inf,
    1e308,
    1e12,
    -1.0,
    0.0,
    1e-300,
    10**400,
    True,
    None,
    "x",
    b"1",
    [1.0],
    {},
    1j,
    np.full((2, 2), np.nan),
)
QUERIES = ("estimate", "belief", "learnt", "trajectory", "diagnostics")


def value(*usual):
    """Mostly one of the usual values, else any number, or an absurd one."""
    return st.sampled_from(usual * 12) | st.floats() | st.sampled_from(ABSURD)


def array(values):
    """An array of the values; of any objects if their shapes differ."""
    try:
        return np.array(values)
    except ValueError:
        objects = np.empty(len(values), dtype=object)
        for i, each in enumerate(values):
            objects[i] = each
        return objects


@cache
def calls():
    """Strategy of a call: a method, and its arguments."""
    log = sound_files.drive()
    t, count = value(*np.linspace(0.0, 3.0, 31).tolist()), st.integers(0, 3)
    names = st.lists(st.sampled_from((*log.world.landmarks, *log.world.points.names[:5], "stranger")), max_size=3)
    tags = st.lists(st.sampled_from((*log.world.tags, "stranger")), max_size=3)
    many = st.lists(value(2.0, 0.3), max_size=3).map(array) | value(None)
    pixels = count.flatmap(lambda n: value(*(size * np.ones((n, 2)) for size in (100.0, 200.0, -9.0))))
    looks = count.flatmap(lambda n: value(np.zeros((n, 64), np.float32), np.zeros((n, 32), np.uint8)))
    covariance = value(None, np.eye(3), np.zeros((3, 3)), -np.eye(3), 1e18 * np.eye(3))
    antennas = value(("1", "2"), ("1",), ("1", "1"))
    made = st.one_of(
        st.sampled_from(list(log.measurements(("odometry", "imu", "rfid", "bearing_range", "sightings")))),
        st.builds(fgloc.VelocityOdometry, t, value(0.5), value(0.1)),
        st.builds(fgloc.IncrementOdometry, t, value(0.05), value(0.0), value(0.01)),
        st.builds(fgloc.YawRate, t, value(0.1)),
        st.builds(fgloc.BearingRange, t, names.map(tuple) | value(()), many, many),
        st.builds(fgloc.PixelSightings, t, names.map(tuple) | value(()), pixels),
        st.builds(fgloc.RfidScan, t, antennas, value(np.zeros(2, int)), tags.map(tuple), many, many, many, many),
        st.builds(fgloc.CameraFrame, t, value("colour", "orb"), pixels, many, looks, value(np.arange(2))),
        st.builds(fgloc.Position, t, value(10.0), value(6.0), *(value(v) for v in (0.01, 0.0, 0.01))),
        value(None),
    )
    pose = st.tuples(value(10.0), value(6.0), value(0.5)) | value(log.start.pose)
    given_up = st.tuples(st.just("initialize"), st.tuples(pose, covariance, value(None, 0.0)))
    images = st.builds(fgloc.CameraImage, t, value(np.zeros((480, 640), np.uint8), np.zeros((2, 2))))
    images = images.map(lambda image: ("push", (image,)))
    pushed = made.map(lambda m: ("push", (m,)))
    asked = st.sampled_from([(name, ()) for name in QUERIES]) | t.map(lambda t: ("estimate", (t,)))
    return st.one_of(pushed, pushed, pushed, pushed, asked, asked, images, given_up)


def play(estimator, settings, calls, *, ask):
    """The last estimate after these calls, and those that were taken; without ``ask`` no queries."""
    log, taken = sound_files.drive(), []
    rig = log.rig.model_copy(update={"position": fgloc.Rig.model_validate({"position": {}}).section("position")})
    localizer = fgloc.Localizer(rig, log.world, estimator, settings=settings, history=1.0, sensors=SENSORS)
    for method, arguments in calls:
        if method in QUERIES and not ask:
            continue
        with taken_or_refused(failed=lambda call=(method, arguments): taken.append(call)):
            found = getattr(localizer, method)(*arguments)
            taken.append((method, arguments))
            if method == "estimate" and found.status != "unlocalized":
                require_sound(found.pose[None], found.covariance[None])
            elif method == "trajectory":
                assert np.isfinite(found.poses).all()
    last = None
    with taken_or_refused():
        last = localizer.estimate()
    return last, taken


@examples(cost=2)
@given(
    estimator=st.sampled_from(ESTIMATORS),
    start=st.sampled_from([[], [("initialize", ((10.0, 6.0, 0.5),))]]),
    calls=st.deferred(lambda: st.lists(calls(), min_size=2, max_size=20)),
)
def test_calls_in_any_order(estimator, start, calls):
    first, taken = play(*estimator, start + calls, ask=True)
    again, _ = play(*estimator, taken, ask=False)
    assert (first is None) == (again is None)
    if first is not None:
        assert first.status == again.status
        np.testing.assert_array_equal(first.pose, again.pose)
        np.testing.assert_array_equal(first.covariance, again.covariance)


SETS = (None, ("odometry",), ("odometry", "bearing_range"), ("odometry", "rfid"))
PRIORS = (None, "reference", "log", "unknown", "0,0,0", "10,6", "1e5,-1e5,3")

BEYOND = ("glitch_beyond_bounds", "clocks_years_apart")  # the bounds of their columns, or of a log's length


# each fault with one of the estimators; of landmarks in no map, some logs give no place
@pytest.mark.parametrize(
    ("fault", "estimator"),
    list(zip(FAULTS, cycle(e for e in ESTIMATORS if "landmarks" not in e[1]), strict=False)),
)
def test_a_log_with_a_fault_is_survived(fault, estimator):
    result = verdict(FAULTS[fault](whole(), np.random.default_rng(len(fault))), *estimator)
    assert result == ("refused" if fault in BEYOND else "ok")


@examples(cost=4)
@given(
    faults=st.lists(st.sampled_from(sorted(FAULTS)), min_size=1, max_size=3),
    seed=st.integers(0, 2**32 - 1),
    estimator=st.sampled_from(ESTIMATORS),
    sensors=st.sampled_from(SETS),
    prior=st.sampled_from(PRIORS),
)
def test_faults_come_together(faults, seed, estimator, sensors, prior):
    log, rng = whole(), np.random.default_rng(seed)
    for fault in faults:
        if all(len(stream.t) > 5 for stream in log.streams.values()):
            log = FAULTS[fault](log, rng)
    verdict(log, *estimator, sensors, prior)

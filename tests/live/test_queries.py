"""Asking changes nothing: whatever is asked of a localizer, and when, all later answers are the same to the last bit."""

import struct
from dataclasses import fields, is_dataclass, replace

import camera_world
import numpy as np
import pytest
from by_hand import started
from hypothesis import given, settings
from hypothesis import strategies as st

import factorgraph_loc as fgloc
from factorgraph_loc import BearingRange

ASKED = ("estimate", "belief", "learnt", "trajectory", "diagnostics")
BOTH, SEEN = ("odometry", "rfid", "bearing_range"), ("odometry", "sightings")
CASES = {
    "dead_reckoning": ("dead_reckoning", BOTH, {}, None),
    "ekf": ("ekf", ("odometry", "bearing_range"), {"landmarks": "extended"}, None),
    "particle_filter": ("particle_filter", BOTH, {"particles": 60, "smoothing_trajectories": 10}, None),
    "particle_filter, anywhere": ("particle_filter", ("odometry", "bearing_range"), {"particles": 60}, "unknown"),
    "switching": ("switching", BOTH, {"particles": 60}, None),
    "smoother": ("smoother", BOTH, {"lag": None}, None),
    "smoother, window": ("smoother", BOTH, {"lag": 1.5}, None),
    "smoother, anywhere": ("smoother", ("odometry", "bearing_range"), {"lag": 1.5}, "unknown"),
    "smoother, maps": ("smoother", ("odometry", "bearing_range"), {"landmarks": "unknown", "lag": None}, None),
    "batch": ("batch", BOTH, {}, None),
}
BY_SIGHT = {
    "ekf": ("ekf", SEEN, {}, None),
    "ekf, anywhere": ("ekf", SEEN, {}, "unknown"),
    "particle_filter": ("particle_filter", SEEN, {"particles": 60, "smoothing_trajectories": 10}, None),
    "monoslam": ("monoslam", SEEN, {}, None),
    "smoother": ("smoother", SEEN, {"lag": None}, None),
    "smoother, window": ("smoother", SEEN, {"lag": 1.5}, None),
    "smoother, maps": ("smoother", SEEN, {"landmarks": "unknown", "lag": None}, None),
    "batch, maps": ("batch", SEEN, {"landmarks": "unknown"}, None),
}


@pytest.fixture(scope="module")
def log():
    """A short drive of a robot that learns constants of its odometry, with landmarks of which some come late."""
    changes = {"drive": {"duration": 4.0}, "world": {"tags": 12, "landmarks": 12}}
    log = fgloc.simulate("office", 3, changes=changes)
    uncertainty = log.rig.odometry.uncertainty.model_copy(update={"scale_distance": 0.05})
    odometry = log.rig.odometry.model_copy(update={"uncertainty": uncertainty})
    return replace(log, rig=log.rig.model_copy(update={"odometry": odometry}))


def bits(value):
    """All that a value holds, to be compared to the last bit."""
    if is_dataclass(value):
        return tuple(bits(getattr(value, field.name)) for field in fields(value))
    if isinstance(value, dict):
        return tuple((bits(key), bits(value[key])) for key in sorted(value))
    if isinstance(value, (list, tuple)):
        return tuple(bits(item) for item in value)
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    return struct.pack("d", value) if isinstance(value, float) else repr(value)


@pytest.fixture(scope="module")
def seen():
    """A short drive in a room whose points a camera sees by name."""
    return camera_world.simulate(seconds=2.5)


def with_rows(log, case):
    """A localizer, and what it is to be given."""
    name, sensors, options, prior = case
    localizer = started(log, name, prior, settings=options, sensors=sensors, seed=5)
    rows = list(log.measurements(sensors))
    late = {m.t for i, m in enumerate(m for m in rows if isinstance(m, BearingRange)) if i % 3 == 1}
    return localizer, sorted(rows, key=lambda m: m.t + 0.3 * (isinstance(m, BearingRange) and m.t in late))


def answers(localizer):
    return {what: bits(getattr(localizer, what)()) for what in ASKED}


questions = st.lists(st.tuples(st.floats(0.0, 1.0), st.sampled_from(ASKED), st.floats(0.0, 5.0)), max_size=12)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_asking_changes_no_answer(log, case):
    unchanged(log, case)


@pytest.mark.parametrize("case", BY_SIGHT.values(), ids=BY_SIGHT)
def test_asking_changes_no_answer_of_a_camera(seen, case):
    unchanged(seen, case)


def unchanged(log, case):
    """What is asked on the way changes nothing that is told at the end."""
    expected, rows = with_rows(log, case)
    for m in rows:
        expected.push(m)
    expected = answers(expected)

    @given(asked=questions)
    @settings(max_examples=5, deadline=None)
    def check(asked):
        localizer, rows = with_rows(log, case)
        for i, m in enumerate(rows):
            localizer.push(m)
            for share, what, ahead in asked:
                if int(share * (len(rows) - 1)) == i:
                    if what == "estimate":
                        localizer.estimate(m.t + ahead)
                    getattr(localizer, what)()
        assert answers(localizer) == expected

    check()


@pytest.mark.parametrize("name", ["ekf", "particle_filter", "smoother, window"])
def test_localizers_share_nothing(log, name):
    """What one is given, and asked, changes nothing that another of the same settings tells."""
    case = CASES[name]
    first, rows = with_rows(log, case)
    second, _ = with_rows(log, case)
    middle = len(rows) // 2
    for m in rows[:middle]:
        first.push(m)
    told = answers(first)
    for m in rows[:middle]:
        second.push(m)
    assert answers(second) == told
    for m in rows[middle:]:
        second.push(m)
    assert answers(first) == told


@pytest.mark.parametrize("name", ["ekf", "particle_filter", "smoother"])
def test_looking_ahead_drops_nothing(log, name):
    """An estimate for a second and a half ahead, each second, leaves what is measured until then in time."""
    localizer, rows = with_rows(log, (name, BOTH, {"particles": 60} if name == "particle_filter" else {}, None))
    asked = 0.0
    for m in rows:
        localizer.push(m)
        if m.t > asked + 1.0:
            asked = m.t
            assert localizer.estimate(m.t + 1.5).t == m.t + 1.5
    assert localizer.diagnostics().late == {}

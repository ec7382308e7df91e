"""What is pushed to a live localizer: what cannot be is refused in one line, and reads of tags become rounds."""

import math

import numpy as np
import pytest
from by_hand import started

import factorgraph_loc as fgloc
from factorgraph_loc import (
    IncrementOdometry,
    InputError,
    RfidRead,
    RfidScan,
)
from factorgraph_loc.sensors.rfid.stream import scan_of


@pytest.fixture(scope="module")
def log():
    """The rig and map of an office."""
    return fgloc.simulate("office", 3, changes={"drive": {"duration": 1.0}, "world": {"tags": 12, "landmarks": 6}})


def test_clocks_that_go_back_or_are_others_are_refused(log):
    localizer = started(log, "ekf")
    localizer.push(IncrementOdometry(5.0, 0.1, 0.0, 0.0))
    with pytest.raises(
        InputError, match=r"IncrementOdometry at 4.900 s: follows one at 5.000 s, expected increments in order"
    ):
        localizer.push(IncrementOdometry(4.9, 0.1, 0.0, 0.0))
    with pytest.raises(InputError, match=r"IncrementOdometry at 1700000000.000 s: is 1699999995 s ahead of all others"):
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
        ({}, "ekf cannot start from an unknown pose with this rig and map, expected a pose"),
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

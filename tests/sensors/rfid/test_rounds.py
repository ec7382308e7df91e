"""Reads into inventory rounds."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from factorgraph_loc.sensors.rfid.tables import OUTSIDE, ends_of, rounds_from_gaps, rounds_from_inventories


def ns(*values):
    return np.array(values, dtype=np.int64)


def test_a_gap_and_another_antenna_begin_a_round():
    t_ns = ns(0, 10, 60, 111, 112, 113) * 1_000_000
    number = rounds_from_gaps(t_ns, list("aaaabb"), 0.05)
    assert number.tolist() == [0, 0, 0, 1, 2, 2]  # 50 ms are no gap, 51 ms are
    # known to be over after a gap, or by the other antenna's first read
    assert ends_of(t_ns, number, 0.05).tolist() == [110_000_000, 112_000_000, 163_000_000]


def test_no_reads():
    number = rounds_from_gaps(ns(), [], 0.05)
    assert (len(number), len(ends_of(ns(), number, 0.05))) == (0, 0)


def test_reads_of_inventories():
    ends, antennas, durations = ns(100, 100, 200, 150), list("abab"), ns(50, 100, 100, 10)
    reads = [(50, "a"), (49, "a"), (100, "a"), (100, "b"), (150, "b"), (101, "a"), (139, "b"), (201, "a"), (60, "c")]
    t, by = zip(*reads, strict=True)
    found = rounds_from_inventories(ns(*t), by, ends, antennas, durations)
    assert found.tolist() == [0, OUTSIDE, 0, 1, 3, 2, OUTSIDE, OUTSIDE, OUTSIDE]


@given(st.lists(st.tuples(st.integers(0, 300), st.sampled_from("ab")), max_size=30), st.integers(0, 40))
def test_inventories_made_from_gaps_hold_the_same_reads(reads, gap):
    reads = sorted(reads)
    t_ns = ns(*(t for t, _ in reads))
    antenna = [a for _, a in reads]
    number = rounds_from_gaps(t_ns, antenna, gap * 1e-9)
    ends = ends_of(t_ns, number, gap * 1e-9)
    first = np.searchsorted(number, np.arange(len(ends)))
    of_rounds = [antenna[i] for i in first]
    found = rounds_from_inventories(t_ns, antenna, ends, of_rounds, ends - t_ns[first])
    for i, j in enumerate(found):
        # reads of one antenna at one stamp, with another's between them, may be of either of two rounds that end there
        assert j == number[i] or ends[j] == t_ns[i] == t_ns[first[number[i]]]
        assert of_rounds[j] == antenna[i]

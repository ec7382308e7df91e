"""What estimators tell of measurements: each counts once, in time or late, and also where an estimator goes back in time."""

import numpy as np

from factorgraph_loc import PoseEstimate
from factorgraph_loc.model.belief import gaussian_belief
from factorgraph_loc.model.diagnostics import Diagnostics


def test_what_is_taken_back_leaves_no_trace():
    diagnostics = Diagnostics()
    diagnostics.innovation("camera", 1.0, 2.0, 2)
    diagnostics.ignore("stranger", 2)
    before = repr(diagnostics)
    added = diagnostics.record()
    diagnostics.innovation("camera", 2.0, 2.0, 2)
    diagnostics.innovation("rfid", 2.0, 1.0, 1)
    diagnostics.add_residuals("camera.u", (1.0, 2.0))
    diagnostics.ignore("stranger")
    diagnostics.reject("astray", 3)
    diagnostics.take_back(added)
    assert repr(diagnostics) == before


def test_counts_that_did_not_rise_are_not_taken_back():
    """Images without a feature are ignored as 0 features."""
    diagnostics, written = Diagnostics(), []
    for _ in range(2):
        added = diagnostics.record()
        diagnostics.ignore("camera", 0)
        written.append(added)
    for one in reversed(written):
        diagnostics.take_back(one)
    assert not any(diagnostics.ignored.values())


def test_nothing_is_believed_where_the_estimate_is_not_a_number():
    nowhere = PoseEstimate(0.0, np.full(3, np.nan), np.full((3, 3), np.nan), "unlocalized")
    assert gaussian_belief(nowhere).modes == ()


def test_rows_that_were_dropped_meanwhile_cannot_be_taken_back():
    """A robot that runs for long keeps the last rows alone, fewer than it may go back by."""
    diagnostics, written = Diagnostics(), []
    for t in range(3):
        added = diagnostics.record()
        for _ in range(4):
            diagnostics.innovation("camera", float(t), 2.0, 2)
        written.append(added)
    del diagnostics.nis["camera"][:-5]
    for one in reversed(written):
        diagnostics.take_back(one)
    assert diagnostics.nis == {}


def test_rows_are_taken_back_whatever_came_after_them():
    """A late look is taken after newer ones; going back to between them leaves its row, and takes theirs."""
    diagnostics, written = Diagnostics(), {}
    for t in (5.0, 6.0, 4.9):
        added = diagnostics.record()
        diagnostics.innovation("camera", t, 2.0, 2)
        diagnostics.add_residuals("camera.u", (10.0 * t,))
        written[t] = added
    for t in (6.0, 5.0):
        diagnostics.take_back(written[t])
    assert diagnostics.nis == {"camera": [(4.9, 2.0, 2)]}
    assert diagnostics.residuals == {"camera.u": [49.0]}

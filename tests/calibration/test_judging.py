"""When an estimator is better with a parameter than without."""

import numpy as np
import pytest

from factorgraph_loc.calibration.judging import StretchErrors, judged

NAMES = ("bearing_range.range_scale",)


def outcome(positions, headings=0.05, nees=3.0):
    """Of stretches with these position errors, 1000 poses each; causal and final alike."""
    table = np.broadcast_arrays(positions, headings, nees)
    rows = [
        {
            f"{kind}.{n}": v
            for kind in ("causal", "final")
            for n, v in zip(("position_rmse", "heading_rmse", "anees"), row, strict=True)
        }
        | {"causal.scored": 1000, "final.scored": 1000}
        for row in zip(*(column.tolist() for column in table), strict=True)
    ]
    return StretchErrors.of([None if np.isnan(row["causal.position_rmse"]) else row for row in rows], 3)


OLD = np.array((0.10, 0.12, 0.08, 0.11))


def test_a_smaller_error_everywhere_is_accepted():
    found = judged(NAMES, outcome(0.9 * OLD), outcome(OLD))
    assert found.accepted
    assert found.gain == pytest.approx(-2.0 * np.log(0.9))
    assert found.error == pytest.approx(0.0, abs=1e-9)
    assert found.new[0, 0] == pytest.approx(0.9 * found.old[0, 0])


def test_what_changes_nothing_is_refused():
    found = judged(NAMES, outcome(OLD), outcome(OLD))
    assert not found.accepted
    assert "does not improve" in found.why


def test_a_gain_within_chance_is_refused():
    """Better on two stretches, worse on the two others."""
    found = judged(NAMES, outcome(OLD * (0.5, 1.1, 0.6, 1.1)), outcome(OLD))
    assert 0.0 < found.gain < found.error
    assert not found.accepted


@pytest.mark.parametrize("nees", [30.0, 0.3])
def test_honest_covariances_are_a_gain_and_those_of_too_little_trust_too(nees):
    assert judged(NAMES, outcome(OLD), outcome(OLD, nees=nees)).accepted
    assert not judged(NAMES, outcome(OLD, nees=nees), outcome(OLD)).accepted


def test_a_larger_error_is_refused_whatever_the_consistency():
    found = judged(NAMES, outcome(1.5 * OLD), outcome(OLD, nees=60.0))
    assert found.gain > found.error
    assert not found.accepted
    assert "increases the error" in found.why
    assert not judged(NAMES, outcome(OLD, headings=0.06), outcome(OLD, nees=60.0)).accepted


def test_an_estimator_that_fails_on_a_stretch_is_worse():
    lost = outcome(0.5 * OLD * (1.0, np.nan, 1.0, 1.0))
    assert not judged(NAMES, lost, outcome(OLD)).accepted
    assert judged(NAMES, outcome(OLD), lost).accepted


def test_without_headings_and_covariances_the_position_is_judged():
    rows = [{"causal.position_rmse": p, "final.position_rmse": p, "causal.scored": 9, "final.scored": 9} for p in OLD]
    new = [row | {"causal.position_rmse": 0.9 * row["causal.position_rmse"]} for row in rows]
    found = judged(NAMES, StretchErrors.of(new, 2), StretchErrors.of(rows, 2))
    assert found.accepted
    assert found.gain == pytest.approx(-np.log(0.9))

"""The search for the factor that makes ANEES ideal, with an estimator whose ANEES is a known function of the noise."""

import pytest

from factorgraph_loc.calibration.consistency import make_consistent
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.landmarks.calibrator import CALIBRATOR
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings

RIG = Rig(bearing_range=BearingRangeSettings(range_sigma=0.1, range_sigma_relative=0.02, bearing_sigma=0.01))

inflated = CALIBRATOR.inflated


@pytest.fixture(scope="module")
def log(simulate):
    return simulate(seconds=30.0)


def evaluate_as(anees):
    """Scores with ANEES ``anees(factor)``, causal and final, of a log whose rig is ``RIG`` times factor."""
    calls = []

    def evaluate(log):
        calls.append(log)
        causal, final = anees(log.rig.bearing_range.range_sigma / RIG.bearing_range.range_sigma)
        return {"causal.anees": causal, "final.anees": final, "causal.scored": 1000, "final.scored": 1000}

    evaluate.calls = calls
    return evaluate


def test_causal_anees_becomes_ideal(log):
    evaluate = evaluate_as(lambda f: (60.0 / f**1.7 + 0.3, 70.0 / f**1.7))
    found = make_consistent([log], RIG, evaluate, 3.0, inflated)
    assert found.reached
    assert found.trial.causal == pytest.approx(1.0, rel=0.1)
    assert found.rig == inflated(RIG, found.trial.factor)
    assert len(evaluate.calls) <= 6


def test_a_final_that_is_too_sure_has_its_say(log):
    found = make_consistent([log], RIG, evaluate_as(lambda f: (30.0 / f, 90.0 / f)), 3.0, inflated)
    assert found.reached
    assert found.trial.causal * found.trial.final == pytest.approx(1.0, rel=0.2)


def test_what_no_factor_reaches_is_said(log):
    found = make_consistent([log], RIG, evaluate_as(lambda f: (30.0 + 1.0 / f, 30.0)), 3.0, inflated)
    assert not found.reached


def test_without_scores_the_noise_is_the_scatter(log):
    def unscored(_):
        return {"causal.anees": 0.0, "final.anees": 0.0, "causal.scored": 1, "final.scored": 1}

    found = make_consistent([log], RIG, unscored, 3.0, inflated)
    assert found.trial is None
    assert found.rig == RIG

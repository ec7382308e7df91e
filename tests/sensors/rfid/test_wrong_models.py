"""Antennas that are not as the rig says: each estimator learns range, read probability, yaw and time offset on the way."""

import re
from functools import cache

import numpy as np
import pytest
from changed_logs import with_rig

from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.rfid.settings import (
    AntennaSettings,
    BeamSettings,
    PriorSettings,
    RfidSettings,
    RfidUncertainty,
)
from factorgraph_loc.simulation import preset, simulate
from factors import se2

EXACT = PriorSettings(range_scale=0.0, read_rate=0.0)


@cache
def office() -> Log:
    return simulate(preset("office", {"drive": {"duration": 60.0}}), 5)


def told(log: Log, prior: PriorSettings | None = None, **changes: float) -> Log:
    """The log with a rig whose antennas have other parameters than those that made its reads."""
    model = log.rig.of(RfidSettings).models["default"].model_copy(update=changes)
    if prior is not None:
        model = model.model_copy(update={"prior": prior})
    return with_rig(log, "rfid", models={"default": model})


@cache
def exact(estimator: str):
    """The outcome with what made the reads, known exactly."""
    return outcome(told(office(), EXACT), estimator)


def outcome(log: Log, estimator: str):
    result = run(log, RunConfig(estimator, {"particles": 1000} if estimator == "particle_filter" else {}))
    return result, score(result, log)


def test_a_range_that_is_too_long_is_found():
    log, estimator = office(), "smoother"  # each estimator learns it on the logs of stored results
    model = log.rig.of(RfidSettings).models["default"]
    assert isinstance(model, BeamSettings)
    _, best = exact(estimator)
    result, found = outcome(told(log, r_max=1.2 * model.r_max), estimator)
    assert found["causal.position_rmse"] < 1.25 * best["causal.position_rmse"]
    assert found["causal.anees"] < 6.0
    value, sigma = result.learnt.values["rfid.range_scale"]
    # the edge of the reads keeps its width, which is not in proportion
    assert value == pytest.approx(-np.log(1.2), abs=0.03)
    assert 0.0 < sigma < 0.02
    (warning,) = (w for w in result.warnings if w.kind == "range")
    assert 14.0 < warning.fields["percent"] < 18.0
    assert warning.fields["direction"] == "less far"


def test_a_read_probability_that_is_too_low_is_found():
    result, found = outcome(told(office(), p0=0.5), "particle_filter")
    assert found["causal.anees"] < 6.0
    value, sigma = result.learnt.values["rfid.read_rate"]
    assert abs(value - np.log(9.0)) < 5.0 * sigma + 0.1
    assert [w.fields["expected"] for w in result.warnings if w.kind == "read_rate"] == [50.0]


def test_antennas_that_are_turned_and_a_late_clock_are_found():
    log, turn, estimator = office(), np.radians(10.0), "ekf"
    rfid = log.rig.of(RfidSettings)
    turned = {
        name: a.model_copy(update={"yaw": se2.wrap_scalar(a.yaw + turn)}) for name, a in rfid.all_antennas().items()
    }
    unsure = RfidUncertainty(yaw=0.1, time_offset=0.2)
    wrong = with_rig(log, "rfid", preset=None, antennas=turned, time_offset=0.15, uncertainty=unsure)
    result, found = outcome(wrong, estimator)
    _, best = exact(estimator)
    assert found["causal.position_rmse"] < 1.35 * best["causal.position_rmse"]
    assert found["causal.anees"] < 5.0
    learnt = result.learnt.values
    yaws = [learnt["rfid.yaw"][0] + learnt[f"rfid.antennas.{name}.yaw"][0] for name in turned]
    assert np.mean(yaws) == pytest.approx(-turn, abs=np.radians(2.5))
    assert learnt["rfid.time_offset"][0] == pytest.approx(-0.15, abs=0.05)
    warnings = {w.kind: w.fields for w in result.warnings}
    assert re.search(r"rfid\.antennas\.3\.yaw = 1\.[56]", warnings["antenna_yaw"]["settings"])
    assert (warnings["time_offset"]["late"], warnings["time_offset"]["section"]) == ("later", "rfid")


def test_what_is_known_exactly_is_not_learnt():
    result, _ = exact("smoother")
    assert not [name for name in result.learnt.values if name.startswith("rfid")]


def test_nothing_is_said_of_antennas_that_are_as_the_rig_says():
    result, _ = outcome(office(), "smoother")
    assert set(result.learnt.values) >= {"rfid.range_scale", "rfid.read_rate"}
    assert not [w for w in result.warnings if w.kind in ("range", "read_rate")]


def test_parameters_are_named_after_their_models_where_antennas_have_several():
    models = {"default": BeamSettings(), "narrow": BeamSettings(sigma_phi=0.4), "unused": BeamSettings()}
    antennas = {"a": AntennaSettings(), "b": AntennaSettings(model="narrow")}
    several, one = (
        RfidSettings(antennas=antennas, models=models),
        RfidSettings(antennas={"a": antennas["a"]}, models=models),
    )
    assert several.estimated().names == (
        *("default.range_scale", "default.read_rate", "narrow.range_scale", "narrow.read_rate"),
        *("yaw", "antennas.a.yaw", "antennas.b.yaw", "time_offset"),
    )
    assert one.estimated().names == ("range_scale", "read_rate", "yaw", "time_offset")
    assert one.estimated().indices == (0, 1, 6, 8)

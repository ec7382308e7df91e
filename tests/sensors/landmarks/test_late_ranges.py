"""Runs with late ranges: each estimator is as good as without them, and the share is learnt."""

from dataclasses import replace

import numpy as np
import pytest

import factorgraph_loc as fgloc
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.base import Binding
from factorgraph_loc.sensors.landmarks.sensor import LandmarkSensor, bind
from factorgraph_loc.sensors.motion import Motion
from factorgraph_loc.simulation.settings import named_settings
from factors.landmarks.late import LateShares

SENSORS = ("odometry", "bearing_range")


def office(share=0.0, seed=1, seconds=120.0, **rig):
    """A drive of a robot with a radio through an office with anchors."""
    changes = {
        "world": {"tags": 0, "landmarks": 20},
        "drive": {"duration": seconds},
        "sightings": {"rate": 4.0, "max_range": 8.0, "bearings": False, "late": share, "late_by": 0.5},
        "rig": {"bearing_range": {"range_sigma": 0.1, **rig}},
    }
    log = fgloc.simulate(named_settings("office", changes), seed)
    streams = {name: log.streams[name] for name in SENSORS}
    return replace(log, streams=streams, rig=log.rig.model_copy(update={"sensors": SENSORS}))


def figures(log, name, **settings):
    return score(run(log, RunConfig(name, settings)), log)


@pytest.mark.parametrize("name", ["ekf", "particle_filter", "smoother"])
def test_late_ranges_hardly_change_the_error(name):
    settings = {"particles": 500} if name == "particle_filter" else {}
    runs = {"clean": (0.0, {}), "late": (0.2, {}), "ignored": (0.2, {"late": 0.0})}
    found = {
        key: [figures(office(share, seed, 60.0, **rig), name, **settings) for seed in (2, 3, 4)]
        for key, (share, rig) in runs.items()
    }
    for kind in ("causal", "final"):
        clean, late, ignored = (np.mean([f[f"{kind}.position_rmse"] for f in figs]) for figs in found.values())
        assert late < 1.3 * clean
        assert late < 0.9 * ignored
        assert 1.5 < np.mean([f[f"{kind}.anees"] for f in found["late"]]) < 4.5


def test_a_log_without_late_ranges_has_the_results_of_a_rig_without_them():
    with_prior, without = (figures(office(late=prior), "smoother") for prior in (0.1, 0.0))
    for kind in ("causal", "final"):
        assert with_prior[f"{kind}.position_rmse"] == pytest.approx(without[f"{kind}.position_rmse"], rel=0.01)


@pytest.mark.parametrize("name", ["ekf", "smoother"])
def test_biases_of_landmarks_are_learnt_beside_late_ranges(name):
    biased = {"uncertainty": {"range_bias": 0.2}}
    late, ignored = (figures(office(0.2, 3, **biased, late=prior), name) for prior in (0.1, 0.0))
    assert late["causal.position_rmse"] < ignored["causal.position_rmse"]
    assert late["causal.anees"] < ignored["causal.anees"]


@pytest.fixture
def sensors(monkeypatch):
    """The sensors of the runs of a test."""
    bound = []
    original = LandmarkSensor.__init__

    def remembered(self, *arguments):
        original(self, *arguments)
        bound.append(self)

    monkeypatch.setattr(LandmarkSensor, "__init__", remembered)
    return bound


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_the_share_is_learnt_while_driving(sensors, share):
    run(office(share), RunConfig("ekf"))
    (sensor,) = sensors
    found = sensor._late.expected
    assert found.share == pytest.approx(share, rel=0.5, abs=0.01)
    assert not share or found.mean == pytest.approx(0.5, rel=0.3)


def test_what_came_after_a_time_is_forgotten():
    log = office(seconds=2.0)
    setup, diagnostics = Setup(log.rig, log.world, SENSORS, np.random.default_rng(0)), Diagnostics()
    sensor = bind(Binding(setup, Motion(setup.rig, SENSORS, diagnostics), diagnostics))
    states = [LateShares(0.1).updated(np.full(1, -float(k)), np.full(1, 10.0), np.zeros(1)) for k in range(5)]
    for t in range(4):
        sensor._late_before.append((float(t), states[t]))
    sensor._late = states[4]
    sensor.rewind(1.0)
    assert sensor._late is states[2]
    sensor.restart(0.0)
    assert sensor._late.log_weights is None


def test_late_ranges_are_simulated():
    clean, late = office(), office(0.2)
    excess = late.streams["bearing_range"].range - clean.streams["bearing_range"].range
    assert np.isnan(late.streams["bearing_range"].bearing).all()
    assert set(np.round(excess, 9)) == {0.0, 0.5}
    assert np.mean(excess > 0.0) == pytest.approx(0.2, abs=0.04)

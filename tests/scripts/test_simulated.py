"""Runs and trials on simulated logs: what is counted, and when; and the optimal filter on a small room."""

import math
from dataclasses import replace

import numpy as np
import pytest
from benchmarking.ensemble import EnsembleJob, run_ensemble, series, stacked
from rfid_benchmark import simulated_trials
from rfid_benchmark.optimal import optimal_filter, without_constants
from rfid_benchmark.simulated_trials import SimulatedTrialJob, run_simulated_trials

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.simulation import simulate
from factorgraph_loc.simulation.settings import preset

ROOM = {"world": {"plan": "hall", "width": 6, "depth": 4, "tags": 8}, "drive": {"duration": 12}}


@pytest.fixture(scope="module")
def room():
    return preset("office", ROOM)


def test_errors_before_the_first_localized_estimate_are_not_scored(room):
    configs = {"known": RunConfig("smoother"), "unknown": RunConfig("smoother", prior="unknown")}
    found = run_ensemble(EnsembleJob(room, 3, configs))
    known, unknown = found["known"], found["unknown"]
    assert known.share("localized") == 1.0
    assert np.isfinite(known.causal.position).all()
    assert len(known.final.t) == 121
    assert known.causal.position_rmse() < 0.3
    localized = np.array(unknown.status) == "localized"
    assert 0.2 < unknown.share("localized") < 1.0
    assert np.isnan(unknown.causal.nees[: np.argmax(localized)]).all()
    assert np.isfinite(unknown.causal.nees[np.argmax(localized) :]).all()
    assert stacked([known.causal, known.final]).shape == (2, 121)
    part = known.causal.where(known.causal.t > 5.0)
    assert part.position_rmse() == pytest.approx(np.sqrt(np.mean(known.causal.position[51:] ** 2)))


def test_odometry_without_constants_keeps_the_noise(room):
    """25 drives of 12 s: the scales of 2 % and the drift of 1 degree per metre would show in the sums."""
    turned, way = [], []
    for seed in range(25):
        log = without_constants(simulate(room, seed), seed)
        odometry, truth = log.streams["odometry"], log.reference
        steps = np.diff(truth.at(odometry.t), axis=0)
        ds = np.hypot(steps[:, 0], steps[:, 1])
        error = odometry.dtheta[1:] - np.arctan2(np.sin(steps[:, 2]), np.cos(steps[:, 2]))
        turned.append(error.sum() / np.sqrt(ds.sum()))
        way.append(error[ds > 0.01] / np.sqrt(ds[ds > 0.01]))
        assert not log.rig.estimated("odometry").names
    each = np.concatenate(way)
    # standard deviations of 2 % and of 14 %: four of them, one false alarm in 16,000
    assert each.std() == pytest.approx(np.radians(1.5), rel=4.0 / np.sqrt(2.0 * len(each)))
    assert np.sqrt(np.mean(np.square(turned))) == pytest.approx(np.radians(1.5), rel=4.0 * 0.142)


def test_the_optimal_filter_is_what_particles_come_near(room):
    log = without_constants(simulate(room, 1), 1)
    best = optimal_filter(log)
    assert len(best.t) == 24
    assert series(best, log).position_rmse() < 0.2
    result = run(log, RunConfig("particle_filter", {"particles": 20_000, "smooth": False}))
    rows = np.searchsorted(result.t, best.t - 1e-6)
    assert result.t[rows] == pytest.approx(best.t)
    apart = result.poses[rows] - best.poses
    sigmas = np.sqrt(np.diagonal(best.covariances, axis1=1, axis2=2))
    # Monte-Carlo error and the tables of the likelihood: a tenth of a standard deviation, where the true pose is one away
    assert np.sqrt(np.mean((apart / sigmas) ** 2)) < 0.25
    assert np.sqrt(np.diagonal(result.covariances[rows], axis1=1, axis2=2)) == pytest.approx(sigmas, rel=0.2)


@pytest.mark.parametrize("estimator", ["smoother", "particle_filter"])
def test_unknown_starts_in_a_room_are_right_soon(room, estimator):
    settings = {"particles": 1000} if estimator == "particle_filter" else {}
    (trial,) = run_simulated_trials(SimulatedTrialJob("unknown start", room, (2,), estimator, 5.0, settings))
    assert trial.seed == 2
    assert 0.0 <= trial.seconds <= 5.0
    assert trial.claimed >= 0.0
    assert not trial.false


def test_a_kidnapping_is_recovered_from():
    (trial,) = run_simulated_trials(SimulatedTrialJob("kidnapping", preset("office"), (2,), "smoother", 15.0))
    assert 0.0 < trial.seconds <= 15.0
    assert trial.claimed >= trial.seconds
    assert not trial.false


def test_what_is_localized_elsewhere_is_false(room, monkeypatch):
    def elsewhere(log, config, watch=None):
        result = run(log, config, watch=watch)
        return replace(result, poses=result.poses + np.array((2.0, 0.0, 0.0)))

    monkeypatch.setattr(simulated_trials, "run", elsewhere)
    (trial,) = run_simulated_trials(SimulatedTrialJob("unknown start", room, (2,), "smoother", 5.0))
    assert math.isnan(trial.seconds)
    assert trial.false
    small = room.model_copy(update={"drive": room.drive.model_copy(update={"speed": 0.3})})
    (trial,) = run_simulated_trials(SimulatedTrialJob("kidnapping", small, (1,), "dead_reckoning", 3.0))
    assert trial.false
    assert math.isnan(trial.seconds)

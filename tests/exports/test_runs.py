"""Runs are read back as they were written."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.output import write_run
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.exports.runs import find_runs, is_results, read_runs


def test_a_run_is_read_as_it_was(log, results):
    ekf, dead = reversed(read_runs(find_runs(results), log))
    again = run(log, RunConfig("ekf"))
    assert (ekf.name, dead.name) == ("ekf", "dead_reckoning")
    for trajectory, expected in ((ekf.causal, again.causal()), (ekf.final, again.final)):
        assert np.allclose(trajectory.t, expected.t, atol=1e-9)
        assert np.allclose(trajectory.poses, expected.poses, atol=1e-12)
        assert np.allclose(trajectory.covariances, expected.covariances, atol=1e-12)
    t, errors = ekf.series["error_position"]
    truth = log.reference.at(t)
    assert np.allclose(errors, np.hypot(*(ekf.causal.at(t) - truth)[:, :2].T), atol=1e-6)
    assert ekf.events == ((1.25, "a jump"),)


def test_one_run_or_all_of_a_comparison(results):
    one = results / "store" / "ek" / "ekf"
    assert is_results(one)
    assert [folder.estimator for folder in find_runs(one)] == ["ekf"]
    assert [folder.estimator for folder in find_runs(results)] == ["dead_reckoning", "ekf"]


def test_bad_folders(log, results, tmp_path):
    assert not is_results(tmp_path)
    with pytest.raises(InputError, match="holds no results, expected a folder that `fgloc run`"):
        find_runs(tmp_path)
    with pytest.raises(InputError, match="is a run of the log arc, expected one of hall"):
        read_runs(find_runs(results), replace(log, name="hall"))
    with pytest.raises(InputError, match="is it a run of another log arc"):
        read_runs(find_runs(results), replace(log, t0_ns=0))


def test_of_an_estimator_without_causal_estimates_the_final_ones_are_played(log, tmp_path):
    write_run(run(log, RunConfig("batch")), log, tmp_path / "batch")
    (batch,) = read_runs(find_runs(tmp_path / "batch"), log)
    assert len(batch.causal) == 0
    assert batch.played() is batch.final
    t, errors = batch.series["error_position"]
    assert np.array_equal(t, batch.final.t)
    assert errors.max() < 0.05

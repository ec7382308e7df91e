"""Particles of a run that is made again."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.experiments.output import write_run
from factorgraph_loc.experiments.particles import SHOWN, _drawn, particles_of
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.exports.runs import find_runs, read_runs


@pytest.fixture(scope="module")
def filtered(log, tmp_path_factory):
    """A run of 2,000 particles from a stated start."""
    out = tmp_path_factory.mktemp("filtered") / "run"
    config = RunConfig("particle_filter", {"particles": 2000}, prior="0.1,0,0", seed=3)
    write_run(run(log, config), log, out)
    (found,) = read_runs(find_runs(out), log)
    return found


def test_the_same_run_is_made_again(log, filtered):
    """The cloud's mean is the estimate, within five of its standard errors, of draws that are more even than random ones."""
    found = particles_of(filtered, log)
    assert found.difference < 1e-9
    assert np.allclose(found.t, np.arange(0.0, 6.01, 0.5))
    for t, poses in zip(found.t, found.poses, strict=True):
        assert poses.shape == (SHOWN, 3)
        at = np.searchsorted(filtered.causal.t, t - 1e-6)
        sigma = np.sqrt(np.diag(filtered.causal.covariances[at])[:2] / SHOWN)
        assert np.all(np.abs(poses[:, :2].mean(axis=0) - filtered.causal.poses[at, :2]) < 5.0 * sigma)


def test_another_run_is_told_by_its_difference(log, filtered):
    moved = replace(filtered.causal, poses=filtered.causal.poses + np.array((0.0, 0.25, 0.0)))
    assert particles_of(replace(filtered, causal=moved), log).difference == pytest.approx(0.25)
    fewer = replace(filtered.causal, t=moved.t[1:], poses=moved.poses[1:], covariances=moved.covariances[1:])
    assert particles_of(replace(filtered, causal=fewer), log).difference == np.inf


def test_draws_follow_the_weights():
    weights = np.array((0.0, 3.0, 1.0, 0.0, 4.0))
    assert len(_drawn(weights)) == 5
    many = np.tile(weights, 1000)
    chosen = many[_drawn(many)]
    assert np.all(chosen > 0.0)
    assert np.bincount(_drawn(np.array((1.0, 1.0))), minlength=2).tolist() == [1, 1]

"""Smoother and batch where their place is not known."""

import numpy as np
import pytest
from landmark_world import simulate, with_sightings

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.metrics import errors
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import cut, join


@pytest.fixture(scope="module")
def log():
    return simulate(seconds=20.0)


def test_a_lost_track_is_ambiguous_until_its_place_is_found(log):
    """The new place is told by one landmark for a while: seen well enough to doubt the old one, not to find the new one."""
    elsewhere = cut(simulate(seed=3, seconds=45.0), 25.0, 45.0)
    s = elsewhere.streams["bearing_range"]
    alone = with_sightings(elsewhere, (np.array(s.landmark) == s.landmark[0]) | (s.t > 33.0))
    carried = join(cut(log, 0.0, 10.0), alone)
    result = run(carried, RunConfig("smoother"))
    status = np.array(result.status)
    (t,) = [event.t for event in result.diagnostics.events]
    assert 18.0 < t < 22.0
    assert np.all(status[(result.t > 13.0) & (result.t < t)] == "ambiguous")
    assert np.all(status[result.t > t + 0.1] == "localized")
    final = errors(result.final, carried.reference)
    assert np.nanmax(final.position[final.t > t]) < 0.2


@pytest.mark.parametrize("name", ["smoother", "batch"])
def test_one_landmark_does_not_tell_the_place(name, log):
    """The start stays open, and everything is still there when the others come."""
    s = log.streams["bearing_range"]
    lone = with_sightings(log, np.array(s.landmark) == "b")
    result = run(cut(lone, 0.0, 8.0), RunConfig(name, prior="unknown"))
    assert result.diagnostics.events == []
    assert len(result.final) == 0
    assert "localized" not in result.status
    assert result.causal() is None
    (warning,) = result.warnings
    assert warning.startswith("simulated: never localized: ")
    if name != "batch":
        ambiguous = np.array(result.status) == "ambiguous"
        assert result.status == ("unlocalized",) * int(np.argmax(ambiguous)) + ("ambiguous",) * int(ambiguous.sum())
        assert np.all(np.isfinite(result.poses[ambiguous]))
        distance_of_b = np.hypot(*(result.poses[ambiguous, :2] - log.world.position("b")).T)
        truth = np.hypot(*(log.reference.at(result.t[ambiguous])[:, :2] - log.world.position("b")).T)
        assert np.abs(distance_of_b - truth).max() < 0.5

    late = with_sightings(log, (np.array(s.landmark) == "b") | (s.t > 8.0))
    result = run(late, RunConfig(name, prior="unknown"))
    assert result.final.t[0] < 0.3
    assert errors(result.final, log.reference).position.max() < 0.3


def test_landmarks_that_are_to_be_estimated_cannot_tell_the_place(log):
    with pytest.raises(InputError, match="cannot start from an unknown pose"):
        run(log, RunConfig("smoother", {"landmarks": "unknown"}, prior="unknown"))

"""The particle filter where its place is not known: unknown start, wrong start, kidnapping."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.estimators.cloud import Cloud
from factorgraph_loc.evaluation.metrics import errors, score
from factorgraph_loc.experiments.output import write_run
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.log import BearingRangeStream, cut, join
from factorgraph_loc.readers import load

UNKNOWN = RunConfig("particle_filter", {"particles": 1000}, prior="unknown")
KNOWN = replace(UNKNOWN, prior=None)


@pytest.fixture(scope="module")
def log(simulate):
    return simulate(seconds=20.0)


@pytest.fixture(scope="module")
def kidnapped(log, simulate):
    """After 10 s the robot is carried to where another run is at 25 s."""
    return join(cut(log, 0.0, 10.0), cut(simulate(seed=3, seconds=37.0), 25.0, 37.0))


def only(log, landmarks):
    s = log.streams["bearing_range"]
    rows = [i for i, name in enumerate(s.landmark) if name in landmarks]
    stream = BearingRangeStream(s.t[rows], [s.landmark[i] for i in rows], s.range[rows], s.bearing[rows])
    return replace(log, streams={**log.streams, "bearing_range": stream})


def events(result):
    return [what.partition(":")[0] for _, what in result.diagnostics.events]


def test_unknown_start(log):
    result = run(log, UNKNOWN)
    scores = score(result, log)
    assert result.status[0] == "unlocalized"
    assert events(result) == ["localized"]
    assert scores["time_to_localized"] < 5.0
    assert scores["causal.position_max"] < 0.5
    assert scores["final.position_rmse"] < 0.06
    assert result.final.t[0] < 0.5
    again = run(cut(log, 0.0, 5.0), UNKNOWN)
    np.testing.assert_array_equal(result.poses[:40], again.poses[:40])


def test_late_sightings_of_an_unknown_start(log):
    s = log.streams["bearing_range"]
    order = np.argsort(s.t + np.random.default_rng(3).uniform(0.0, 0.4, len(s.t)), kind="stable")
    stream = BearingRangeStream(s.t[order], [s.landmark[i] for i in order], s.range[order], s.bearing[order])
    result = run(replace(log, streams={**log.streams, "bearing_range": stream}), UNKNOWN)
    assert events(result) == ["localized"]
    assert score(result, log)["causal.position_max"] < 0.6


def test_kidnapped(kidnapped):
    result = run(kidnapped, KNOWN)
    assert events(result) == ["lost", "recovered"]
    lost, recovered = (t for t, _ in result.diagnostics.events)
    assert 10.0 < lost <= recovered < 18.0
    causal, final = (errors(found, kidnapped.reference).position for found in (result.causal(), result.final))
    assert np.nanmax(causal[result.t > recovered + 1.0]) < 0.5
    # the jump is known only after it, but spoils nothing before
    assert np.nanmax(final[result.final.t < 9.0]) < 0.15
    assert np.nanmax(final[result.final.t > recovered]) < 0.3


def test_wrong_start(log):
    result = run(log, replace(KNOWN, prior="4,4,2"))
    assert events(result) == ["lost", "recovered"]
    assert np.nanmax(errors(result.causal(), log.reference).position[result.t > 12.0]) < 0.5


def test_a_known_start_never_seeks(log):
    result = run(log, KNOWN)
    assert result.diagnostics.events == []
    assert set(result.status) == {"localized"}


def test_one_landmark_is_ambiguous(log, tmp_path):
    result = run(only(cut(log, 0.0, 3.0), "b"), UNKNOWN)
    assert set(result.status) == {"unlocalized", "ambiguous"}
    assert result.warnings == ("simulated: never localized: its landmarks leave several places possible",)
    scores = write_run(result, log, tmp_path / "out")
    assert scores["causal.position_rmse"] is None
    assert scores["time_to_localized"] is None


def test_nothing_seen(log, tmp_path):
    result = run(only(log, ()), UNKNOWN)
    assert set(result.status) == {"unlocalized"}
    assert len(result.final) == 0
    assert result.warnings == ("simulated: never localized: no landmark of the map was seen",)
    scores = write_run(result, log, tmp_path / "out")
    assert scores["final.position_rmse"] is None


def test_modes_of_a_cloud():
    rng = np.random.default_rng(1)
    places = np.array(((0.0, 0.0, np.pi), (5.0, 1.0, 0.0), (5.0, 6.0, 0.0)))
    which = np.repeat((0, 1, 2), (600, 300, 100))
    poses = places[which] + 0.1 * rng.standard_normal((1000, 3))
    poses[:, 2] = np.mod(poses[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    modes = Cloud(poses, np.empty((1000, 0)), np.full(1000, -np.log(1000.0))).modes()
    assert [m.weight for m in modes] == pytest.approx([0.6, 0.3, 0.1])
    for mode, place in zip(modes, places, strict=True):
        assert np.hypot(*(mode.pose - place)[:2]) < 0.05
        assert np.cos(mode.pose[2] - place[2]) > 0.999
        np.testing.assert_allclose(np.sqrt(np.diag(mode.covariance)), 0.1, rtol=0.3)


def test_recorded_start_and_kidnapping(data_root):
    (log,) = load("mrclam6-robot3", data_root=data_root)
    carried = join(cut(log, 310.0, 330.0), cut(log, 105.0, 135.0))
    result = run(carried, UNKNOWN)
    assert events(result) == ["localized", "lost", "recovered"]
    assert errors(result.causal(), carried.reference).position[-50:].max() < 0.5

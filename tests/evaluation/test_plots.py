"""The plots are there, wide enough, and survive what a log may lack."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from in_short import blank_pictures  # noqa: F401 - a fixture

from factorgraph_loc import Landmark, Log, Rig, Tag, Trajectory, World
from factorgraph_loc.evaluation.figures import Track
from factorgraph_loc.evaluation.plots import error_bands, plot_log, trajectories
from factorgraph_loc.sensors.rfid.settings import SurveySettings


def width(path: Path) -> int:
    return int(struct.unpack(">I", path.read_bytes()[16:20])[0])


@pytest.fixture
def track():
    t = np.arange(30) * 0.1
    poses = np.stack((t, np.sin(t), t * 0.0), axis=1)
    trajectory = Trajectory(t, poses, np.tile(np.eye(3) * 0.01, (30, 1, 1)))
    return Track(trajectory, trajectory)


def log_of(track, *, reference=True):
    truth = Trajectory(track.final.t, track.final.poses + 0.02) if reference else None
    return Log("log", Rig(), World(landmarks={"a": Landmark(x=1.0, y=2.0)}), {}, truth)


def test_files(track, tmp_path):
    offline = Track(None, track.final)
    paths = plot_log(log_of(track), {"ekf": track, "batch": offline}, tmp_path / "plots")
    names = {"trajectories", "error-distribution"}
    names |= {f"{what}-{who}" for what in ("errors", "consistency") for who in ("ekf", "batch")}
    assert {path.name for path in paths} == {f"log-{name}.png" for name in names}
    assert {width(path) for path in paths} == {1600}
    assert set((tmp_path / "plots").iterdir()) == set(paths)


def test_walls_and_tags_are_drawn_where_the_estimators_take_them_to_be(track):
    """The survey is shifted by 5 m: the tag is drawn there, within the view, and named in the legend."""
    first, second = ((0.0, 0.0), (8.0, 0.0)), ((8.0, 0.0), (8.0, 7.0))
    walls = tuple((*start, *end) for start, end in (first, second))
    world = World(tags={"E2": Tag(x=1.0, y=-4.0)}, walls=walls)
    log = replace(log_of(track), world=world, rig=Rig(survey=SurveySettings(x=5.0)))
    figure, nothing = trajectories(log, {"ekf": track}), (np.nan, np.nan)
    for axis in figure.axes:
        lines = {line.get_label(): line.get_xydata() for line in axis.lines}
        assert "landmarks" not in lines
        np.testing.assert_allclose(lines["tags"], ((6.0, -4.0),))
        np.testing.assert_array_equal(lines["walls"], (*first, nothing, *second, nothing))
        for (low, high), values in zip((axis.get_xlim(), axis.get_ylim()), ((0.0, 8.0), (-4.0, 7.0)), strict=True):
            assert low < values[0]
            assert values[1] < high
    assert {"tags", "walls", "reference", "ekf"} <= {text.get_text() for text in figure.legends[0].texts}


def test_without_reference(track, tmp_path):
    log = log_of(track, reference=False)
    paths = plot_log(log, {"ekf": track}, tmp_path)
    assert {path.name for path in paths} == {"log-trajectories.png"}
    told = replace(track, nis={"bearing_range": np.array([(1.0, 2.0, 2.0)])})
    paths = plot_log(log, {"ekf": told}, tmp_path)
    assert {path.name for path in paths} == {"log-trajectories.png", "log-consistency-ekf.png"}


def test_a_run_that_nothing_told_the_pose(track, tmp_path):
    """Its log is plotted, with an empty line; one that found its place stands beside it."""
    nowhere = Track(None, Trajectory(np.empty(0), np.empty((0, 3)), np.empty((0, 3, 3))))
    paths = plot_log(log_of(track), {"ekf": nowhere}, tmp_path)
    assert [path.name for path in paths] == ["log-trajectories.png"]
    paths = plot_log(log_of(track), {"ekf": nowhere, "batch": track}, tmp_path)
    assert {path.name for path in paths if "ekf" in path.name or "errors" in path.name} == {"log-errors-batch.png"}


def test_no_line_is_drawn_across_a_gap(track):
    """Twice the same three seconds, an hour apart: trajectories, reference and bands have a hole between them."""
    t = np.concatenate((track.final.t, track.final.t + 3600.0))
    twice = Trajectory(t, np.tile(track.final.poses, (2, 1)), np.tile(track.final.covariances, (2, 1, 1)))
    gone = replace(track, causal=twice, final=twice)
    log = log_of(gone)
    figure = trajectories(log, {"ekf": gone})
    lines = [line for axis in figure.axes for line in axis.lines if len(line.get_xdata()) > 50]
    assert len(lines) >= 3
    for line in lines:
        assert np.flatnonzero(np.isnan(line.get_ydata())).tolist() == [30]
    for axis in error_bands(log, log.reference, "ekf", gone).axes:
        (band,) = axis.collections
        assert len(band.get_paths()) == 2

"""The plots are there, wide enough, and survive what a log may lack."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factorgraph_loc.evaluation.figures import Track
from factorgraph_loc.evaluation.plots import error_bands, plot_log, plot_run, remove_plots, trajectories
from factorgraph_loc.log import Log
from factorgraph_loc.rig import Rig
from factorgraph_loc.trajectory import Trajectory
from factorgraph_loc.world import Landmark, World


def width(path: Path) -> int:
    return int(struct.unpack(">I", path.read_bytes()[16:20])[0])


@pytest.fixture
def track():
    t = np.arange(30) * 0.1
    poses = np.stack((t, np.sin(t), t * 0.0), axis=1)
    trajectory = Trajectory(t, poses, np.tile(np.eye(3) * 0.01, (30, 1, 1)))
    return Track(trajectory, trajectory, np.array([0.1, 0.2, 0.5]))


def log_of(track, *, reference=True, has_heading=True):
    truth = Trajectory(track.final.t, track.final.poses + 0.02, has_heading=has_heading) if reference else None
    return Log("log", Rig(), World(landmarks={"a": Landmark(x=1.0, y=2.0)}), {}, truth)


def test_files(track, tmp_path):
    offline = Track(None, track.final, track.update_ms)
    paths = plot_log(log_of(track), {"ekf": track, "batch": offline}, tmp_path / "plots", "log")
    names = {"trajectories", "update-time", "error-distribution"}
    names |= {f"{what}-{who}" for what in ("errors", "consistency") for who in ("ekf", "batch")}
    assert {path.name for path in paths} == {f"log-{name}.png" for name in names}
    assert {width(path) for path in paths} == {1600}
    assert set((tmp_path / "plots").iterdir()) == set(paths)


def test_files_of_one_run(track, tmp_path):
    paths = plot_run(log_of(track), "ekf", track, tmp_path, "log")
    assert {path.name for path in paths} == {f"log-{n}.png" for n in ("trajectories", "errors-ekf", "consistency-ekf")}
    (tmp_path / "mine.png").write_text("mine")
    remove_plots(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.png"]
    remove_plots(tmp_path / "nowhere")


def test_without_reference(track, tmp_path):
    log = log_of(track, reference=False)
    paths = plot_log(log, {"ekf": track}, tmp_path, "log")
    assert {path.name for path in paths} == {"log-trajectories.png", "log-update-time.png"}
    told = replace(track, nis={"bearing_range": np.array([(1.0, 2.0, 2.0)])})
    paths = plot_run(log, "ekf", told, tmp_path, "log")
    assert {path.name for path in paths} == {"log-trajectories.png", "log-consistency-ekf.png"}


def test_events_are_marked_in_all_panels_and_named_once(track):
    log = log_of(track)
    figure = error_bands(log, log.reference, "ekf", replace(track, events=((0.5, "lost"), (1.5, "found"))))
    for axis in figure.axes:
        assert [line.get_xdata()[0] for line in axis.lines if line.get_linestyle() == "--"] == [0.5, 1.5]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels.count("event (see events.csv)") == 1


def test_no_panel_for_a_heading_that_is_not_scored(track):
    log = log_of(track, has_heading=False)
    assert len(error_bands(log, log.reference, "ekf", track).axes) == 4


def test_axes_have_units_and_runs_a_legend(track):
    figure = trajectories(log_of(track), {"ekf": track, "smoother": track})
    assert {axis.get_xlabel() for axis in figure.axes} == {"x [m]"}
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["reference", "landmarks", "ekf", "smoother"]

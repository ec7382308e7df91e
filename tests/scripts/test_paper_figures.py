"""Figure 5: what must be in them is there, also where an estimator has no causal estimate."""

from dataclasses import replace

import numpy as np
import pytest
from paper_figures import fusion

from factorgraph_loc.evaluation.figures import Track
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.rfid.map import Tag


@pytest.fixture
def log():
    t = np.arange(30) * 0.1
    truth = Trajectory(t, np.column_stack((t, 0.5 * t, 0.0 * t)))
    return Log("log", Rig(), World(tags={"T": Tag(x=1.0, y=2.0)}, walls=((0.0, 0.0, 3.0, 0.0),)), {}, truth)


def track(log, off, sigmas=(0.1, 0.2, 0.05), *, causal=True):
    count = len(log.reference)
    poses = log.reference.poses + np.array((off, 0.0, 0.0))
    trajectory = Trajectory(log.reference.t, poses, np.tile(np.diag(np.square(sigmas)), (count, 1, 1)))
    return Track(trajectory if causal else None, trajectory, np.array([0.1]))


def labels(figure):
    return {text.get_text() for text in figure.legends[0].get_texts()}


def test_fusion_shows_errors_and_says_what_is_final(log):
    figure = fusion(log, {"ekf": track(log, 0.1), "batch": track(log, 0.3, causal=False)})
    assert {"ekf", "batch (final)"} < labels(figure)
    drawn = next(axis for axis in figure.axes if axis.get_ylabel() == "position error [m]")
    assert [float(line.get_ydata().max()) for line in drawn.lines] == pytest.approx([0.1, 0.3])


def test_fusion_without_reference_has_the_trajectories(log):
    figure = fusion(replace(log, reference=None), {"ekf": track(log, 0.1)})
    assert labels(figure) == {"walls", "tags", "ekf"}


def test_no_line_is_drawn_across_a_gap(log):
    once = log.reference
    t = np.concatenate((once.t, once.t + 3600.0))
    twice = Trajectory(t, np.tile(once.poses, (2, 1)), np.tile(0.01 * np.eye(3), (len(t), 1, 1)))
    figure = fusion(replace(log, reference=twice), {"ekf": Track(twice, twice, np.array([0.1]))})
    lines = [line for axis in figure.axes for line in axis.lines if len(line.get_xdata()) > 50]
    assert len(lines) >= 3
    for line in lines:
        assert np.flatnonzero(np.isnan(line.get_ydata())).tolist() == [30]

"""Running means against their definition, and what the panels show."""

import numpy as np
import pytest

from factorgraph_loc import Log, Rig, Trajectory, World
from factorgraph_loc.evaluation.figures import WINDOW, Track, consistency, running_mean

T = np.arange(600) * 0.1
BAND = "95 % band (of the single NEES, of the mean NIS)"


def track_of(rng, **kwargs):
    """Errors drawn from the stated covariance, around the origin."""
    covariance = np.diag((0.04, 0.09, 0.01))
    poses = rng.multivariate_normal(np.zeros(3), covariance, len(T))
    trajectory = Trajectory(T, poses, np.tile(covariance, (len(T), 1, 1)))
    return Track(trajectory, trajectory, **kwargs)


def log_of(*, has_heading=True, until=600):
    return Log("log", Rig(), World(), {}, Trajectory(T[:until], np.zeros((until, 3)), has_heading=has_heading))


def line(axis, label):
    (found,) = [drawn for drawn in axis.lines if drawn.get_label() == label]
    return np.array(found.get_ydata())


def test_running_mean_is_that_of_the_window():
    rng = np.random.default_rng(1)
    t = np.sort(rng.uniform(0.0, 100.0, 200))
    values, weights = rng.uniform(0.0, 5.0, 200), rng.integers(0, 3, 200).astype(float)
    mean, total = running_mean(t, values, weights)
    for i in range(200):
        inside = np.abs(t - t[i]) <= WINDOW / 2.0
        assert mean[i] == pytest.approx(values[inside].sum() / weights[inside].sum())
        assert total[i] == weights[inside].sum()
    assert np.isnan(running_mean(np.zeros(1), np.zeros(1), np.zeros(1))[0]).all()


def test_consistent_errors_lie_about_the_ideal():
    """Independent errors: a mean of the 101 NEES of the half window at an end leaves 1.8 to 4.2 in one of 10^5 cases."""
    figure = consistency(log_of(), "ekf", track_of(np.random.default_rng(2)))
    for axis in figure.axes:
        mean = line(axis, "mean over 20 s")
        assert np.all((mean > 1.8) & (mean < 4.2))
        assert set(line(axis, "ideal")) == {3.0}
        assert axis.get_xlabel() == "time [s]"
    assert BAND in [text.get_text() for text in figure.legends[0].get_texts()]


def test_innovations_are_counted_by_degree_of_freedom_and_late_ones_are_put_in_order():
    rows = np.array([(0.0, 2.0, 2.0), (30.0, 6.0, 1.0), (29.0, 3.0, 2.0), (31.0, 0.0, 3.0)])
    figure = consistency(
        log_of(), "ekf", track_of(np.random.default_rng(3), nis={"bearing_range": rows, "imu": rows[:0]})
    )
    assert [axis.get_title() for axis in figure.axes] == ["causal poses", "final poses", "innovations of bearing_range"]
    axis = figure.axes[2]
    np.testing.assert_allclose(line(axis, "single values"), (1.0, 1.5, 6.0, 0.0))
    np.testing.assert_allclose(line(axis, "mean over 20 s"), (np.nan, 1.5, 1.5, 1.5))  # a blackout after the first


def test_gaps_of_the_reference_and_a_heading_that_means_nothing():
    figure = consistency(log_of(has_heading=False, until=300), "ekf", track_of(np.random.default_rng(4)))
    mean = line(figure.axes[0], "mean over 20 s")
    assert np.isfinite(mean[:300]).all()
    assert np.isnan(mean[300:]).all()
    assert set(line(figure.axes[0], "ideal")) == {2.0}
    assert figure.axes[0].get_ylabel() == "NEES of x, y"

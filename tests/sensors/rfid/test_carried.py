"""A robot that is carried while its reader reads on."""

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.sensors.odometry.measurement import IncrementStream
from factorgraph_loc.simulation import preset, simulate

BEGIN, END = 30.0, 42.0  # s


@pytest.mark.parametrize("estimator", ["ekf", "smoother", "particle_filter"])
def test_a_carried_robot_is_lost_at_once_and_found_again(estimator: str) -> None:
    """The wheels stand still for 12 s, while the robot goes on."""
    log = simulate(preset("office", {"drive": {"duration": 75.0}}), 2)
    odometry = log.streams["odometry"]
    assert isinstance(odometry, IncrementStream)
    moves = ~((odometry.t > BEGIN) & (odometry.t <= END))
    still = replace(odometry, dx=odometry.dx * moves, dy=odometry.dy * moves, dtheta=odometry.dtheta * moves)
    result = run(replace(log, streams={**log.streams, "odometry": still}), RunConfig(estimator))
    assert log.reference is not None
    error = np.hypot(*(result.poses[:, :2] - log.reference.at(result.t)[:, :2]).T)
    localized = np.array(result.status) == "localized"
    wrong = np.sum((error > 0.5) & localized) * np.median(np.diff(result.t))
    right = result.t[(result.t >= END) & (error < 0.5) & localized]
    assert localized[result.t < BEGIN].all()
    assert wrong < 10.0
    assert right[0] - END < 15.0
    # nearly nothing was learnt of the tags on the wrong track
    assert sum(p > 0.9 for p in result.diagnostics.doubted["moved_tags"].values()) <= 1

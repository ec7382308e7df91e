"""Landmarks as a sensor of a run."""

from types import SimpleNamespace

import numpy as np

from factorgraph_loc import BearingRange, Rig, World
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.sensors.base import Binding
from factorgraph_loc.sensors.landmarks.sensor import bind
from factorgraph_loc.sensors.motion import Motion


def test_a_track_that_others_confirm_is_no_longer_in_doubt():
    """Landmarks that the map has in wrong places do not begin the same search anew at each look."""
    world = World(landmarks={name: {"x": 3.0, "y": float(y)} for y, name in enumerate("abc")})
    rig = Rig(bearing_range={"range_sigma": 0.05})
    setup = Setup(rig, world, ("odometry", "bearing_range"), np.random.default_rng(0))
    diagnostics = Diagnostics()
    sensor = bind(Binding(setup, Motion(setup.rig, setup.sensors, diagnostics), diagnostics))
    view = SimpleNamespace(
        t=0.0,
        offset=None,
        newest=True,
        localized=True,
        pose=np.zeros(3),
        covariance=1e-4 * np.eye(3),
        value=lambda _: None,
    )
    for k in range(8):
        seen = BearingRange(0.5 * k, ("a", "b", "c"), np.full(3, 9.0), np.full(3, 1.0))
        (observation,) = sensor.observe(seen, view)
        sensor.finder.follow(observation, sensor.finder._motion.state(0.5 * k), view)
    assert sensor.suspicious_since is not None
    sensor.accept()
    assert sensor.suspicious_since is None

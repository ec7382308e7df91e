"""Two seconds of a robot that drives straight ahead."""

import numpy as np
import pytest

from factorgraph_loc import BearingRangeStream, Landmark, Log, Rig, Trajectory, VelocityStream, World
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings


@pytest.fixture
def log():
    """Two seconds straight ahead at 1 m/s along x; a landmark is seen twice at one stamp in each half second."""
    t = np.arange(41) * 0.05
    truth = np.stack((t, 0.0 * t, 0.0 * t), axis=1)
    seen = np.repeat(np.arange(4) * 0.5 + 0.02, 2)
    landmarks = np.array([(5.0, 1.0), (5.0, -1.0)] * 4)
    offset = landmarks - np.stack((seen, 0.0 * seen), axis=1)
    return Log(
        name="straight",
        rig=Rig(bearing_range=BearingRangeSettings(range_sigma=0.1)),
        world=World(landmarks={"a": Landmark(x=5.0, y=1.0), "b": Landmark(x=5.0, y=-1.0)}),
        streams={
            "odometry": VelocityStream(t, np.ones(41), np.zeros(41)),
            "bearing_range": BearingRangeStream(
                seen, ["a", "b"] * 4, np.hypot(*offset.T), np.arctan2(offset[:, 1], offset[:, 0])
            ),
        },
        reference=Trajectory(t, truth),
        t0_ns=1_700_000_000_000_000_000,
    )

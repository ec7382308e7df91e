"""A robot that stands: the odometry tells so, and no estimator is lost over it."""

import camera_world
import numpy as np
import pytest
from drives import even_noise

from factorgraph_loc import Log, Rig, VelocityStream, World
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.sensors.odometry.settings import OdometryNoise, OdometrySettings

PERFECT = even_noise()
DRIVEN = 30.0  # s


def wheels(noise, stood):
    """Half a minute at 0.4 m/s, then at rest for ``stood`` seconds; nothing but wheels."""
    t = np.arange(0.0, DRIVEN + stood, 0.1)
    moves = t < DRIVEN
    stream = VelocityStream(t, np.where(moves, 0.4, 0.0), np.where(moves, 0.05, 0.0))
    rig = Rig(sensors=("odometry",), odometry=OdometrySettings(noise=noise))
    return Log("wheels", rig, World(), {"odometry": stream}, None)


@pytest.mark.parametrize(
    ("estimator", "noise"),
    [
        ("dead_reckoning", OdometryNoise()),
        ("ekf", PERFECT),
        ("smoother", PERFECT),
        ("batch", OdometryNoise()),
        ("smoother", camera_world.NOISE),
        ("particle_filter", PERFECT),
    ],
)
def test_a_robot_at_rest_is_estimated_and_hardly_diffuses(estimator, noise):
    result = run(wheels(noise, stood=20.0), RunConfig(estimator, prior="0,0,0"))
    sigmas = np.sqrt(np.diagonal(result.final.covariances, axis1=1, axis2=2))
    assert np.all(np.isfinite(sigmas))
    assert np.all(sigmas > 0.0)
    if estimator != "particle_filter":  # whose covariances are those of samples
        stopped = result.final.t > DRIVEN + 0.2
        grown = sigmas[stopped][-1] ** 2 - sigmas[stopped][0] ** 2
        # far below a millimetre and a milliradian a second, squared and added up
        np.testing.assert_array_less(np.abs(grown), 20.0 * 1.5e-6)

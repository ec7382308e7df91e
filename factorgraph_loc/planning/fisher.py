"""Expected information on a path for a robot with a nearly known pose, by the Fisher information in closed form.

A Gaussian belief is propagated along the path with the noise of the odometry; at each station the expected information of the
sensors at the mean is added (van Trees, "Detection, Estimation, and Modulation Theory", part I, 1968, section 2.4: the Cramer-Rao
bound). No measurement is drawn. It is valid while the sensor models are nearly linear over the belief.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from factorgraph_loc.planning.information import FINEST, POSITION, gaussian_entropy
from factorgraph_loc.planning.paths import Path
from factorgraph_loc.planning.sensors import SPEED, Sensors
from factors import se2
from factors.motion import ChainState, propagate
from factors.odometry import model as odometry
from factors.se2 import Array


def expected_covariance(mean: Array, covariance: Array, path: Path, sensors: Sensors) -> Array:
    """Expected covariance (3, 3) of x, y, heading in the world frame at the end of a path.

    ``mean`` (3,), ``covariance`` (3, 3): of the belief at its start. The robot observes at each pose of the path but the first.
    """
    body = se2.world_to_body(mean, covariance)
    poses = se2.compose(mean, path.poses)
    passed = path.passed(1.0, sensors.metres_per_radian)
    told = expected_information(poses[1:], np.diff(passed), sensors)
    states = [
        ChainState(way / SPEED, x, y, heading, way, turn, 0.0)
        for way, (x, y, heading), turn in zip(path.way.tolist(), path.poses.tolist(), path.turned.tolist(), strict=True)
    ]
    for (before, after), information in zip(pairwise(states), told, strict=True):
        body = propagate(body, odometry.relative_motion(sensors.odometry, before, after))
        # equals the inverse of the summed information, also for a singular covariance
        body = np.linalg.solve(np.eye(3) + body @ information, body)
        body = (body + body.T) / 2.0
    return se2.body_to_world(poses[-1], body)


def fisher_gain(
    mean: Array, covariance: Array, paths: Sequence[Path], sensors: Sensors, *, dims: Sequence[str] = POSITION
) -> Array:
    """Expected reduction of entropy (C,) [nats] on each of C paths, in the dimensions ``dims``; see :func:`expected_covariance`.
    Accuracy better than :data:`~factorgraph_loc.planning.information.FINEST` counts nothing.
    """
    fine = np.diag(FINEST**2)
    after = [gaussian_entropy(expected_covariance(mean, covariance, path, sensors) + fine, dims) for path in paths]
    return np.asarray(gaussian_entropy(covariance + fine, dims) - np.array(after, dtype=float))


def expected_information(poses: Array, ways: Array, sensors: Sensors) -> Array:
    """Fisher information (N, 3, 3) on a body-frame perturbation of poses (N, 3), from all sensors, while driving ``ways`` (N,)
    metres about each pose, or turning for the same time.
    """
    out = np.zeros((len(poses), 3, 3))
    for forecast in sensors.forecasts:
        out += forecast.information(poses, ways)
    return out

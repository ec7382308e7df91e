"""What a robot whose place is nearly known expects to learn on a path, by Fisher's information in closed form.

A Gaussian belief is carried along the path by the odometry's noise; at each look the information that the sensors are expected to
give at the mean is added (van Trees, "Detection, Estimation, and Modulation Theory", part I, 1968, section 2.4: the bound that
an efficient estimator reaches). No measurement is drawn. It holds while the sensors' models are nearly linear over the belief.
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
    """The covariance (3, 3) of x, y, heading in the world's frame that is expected at the end of a path, of a belief with ``mean``
    (3,) and ``covariance`` (3, 3) in the world's frame at its start. The robot looks at each pose of the path but the first."""
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
        # the same as inverting the sum of informations, also where the belief is certain of something
        body = np.linalg.solve(np.eye(3) + body @ information, body)
        body = (body + body.T) / 2.0
    return se2.body_to_world(poses[-1], body)


def fisher_gain(
    mean: Array, covariance: Array, paths: Sequence[Path], sensors: Sensors, *, dims: Sequence[str] = POSITION
) -> Array:
    """Expected reduction of entropy (C,) [nats] on each of C paths, in the dimensions ``dims``; see :func:`expected_covariance`.
    What is finer than :data:`~factorgraph_loc.planning.information.FINEST` counts nothing."""
    fine = np.diag(FINEST**2)
    after = [gaussian_entropy(expected_covariance(mean, covariance, path, sensors) + fine, dims) for path in paths]
    return np.asarray(gaussian_entropy(covariance + fine, dims) - np.array(after, dtype=float))


def expected_information(poses: Array, ways: Array, sensors: Sensors) -> Array:
    """Fisher's information (N, 3, 3) on the body-frame perturbation of poses (N, 3), from all sensors, of ``ways`` (N,) metres that
    are driven about each, or of turns that take as long."""
    out = np.zeros((len(poses), 3, 3))
    for forecast in sensors.forecasts:
        out += forecast.information(poses, ways)
    return out

"""A robot that moves along x, where all that is measured is x: the problem is linear and Gaussian."""

import numpy as np

from factorgraph_loc import IncrementOdometry, Tick
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.sensors.odometry.settings import GrowthSettings, OdometryNoise, OdometrySettings

STEP, GROWTH = 0.5, 0.1**2  # s; variance by distance [m^2/m]
STIFF = GrowthSettings(per_distance=1e-6)
WHEELS = OdometrySettings(
    noise=OdometryNoise(along=GrowthSettings(per_distance=np.sqrt(GROWTH)), lateral=STIFF, heading=STIFF)
)


def drive(estimator, sigmas, step, measurements):
    """Moves of ``step`` [m], a measurement after each; causal x and variance of x after each."""
    estimator.initialize(PosePrior(0.0, np.zeros(3), np.diag(sigmas**2)))
    estimator.process(IncrementOdometry(0.0, 0.0, 0.0, 0.0))
    causal = []
    for m in measurements:
        estimator.process(IncrementOdometry(m.t, step, 0.0, 0.0))
        estimator.process(m)
        estimator.process(Tick(m.t))
        estimate = estimator.estimate()
        causal.append((estimate.pose[0], estimate.covariance[0, 0]))
    return np.array(causal)


def kalman(places, sigmas, step, noise):
    """The Kalman filter and the Rauch-Tung-Striebel smoother of measured ``places`` of variance ``noise``: rows of
    (mean, variance)."""
    mean, variance = 0.0, sigmas[0] ** 2
    predicted, filtered = [], []
    for measured in places:
        mean, variance = mean + step, variance + GROWTH * step
        predicted.append((mean, variance))
        gain = variance / (variance + noise)
        mean, variance = mean + gain * (measured - mean), (1.0 - gain) * variance
        filtered.append((mean, variance))
    smoothed = [filtered[-1]]
    for (m, v), (pm, pv) in zip(filtered[-2::-1], predicted[:0:-1], strict=True):
        gain = v / pv
        after_m, after_v = smoothed[0]
        smoothed.insert(0, (m + gain * (after_m - pm), v + gain**2 * (after_v - pv)))
    return np.array(filtered), np.array(smoothed)

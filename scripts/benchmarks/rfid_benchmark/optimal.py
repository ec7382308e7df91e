"""The optimal filter on simulated logs whose odometry has white noise only, so that the state consists of the pose alone."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from unittest.mock import patch

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.preparation import resolve_prior
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.sensors.motion import Motion
from factorgraph_loc.sensors.odometry import simulation
from factorgraph_loc.sensors.odometry.settings import OdometryUncertainty
from factorgraph_loc.sensors.rfid.known_tags import KnownTags, extent
from factorgraph_loc.sensors.rfid.settings import PriorSettings, RfidSettings
from factorgraph_loc.sensors.rfid.stream import RfidScan
from factors import se2
from factors.rfid.detection import RfidLikelihood, TagReadCounts
from factors.se2 import Array
from rfid_benchmark.grid_filter import GridFilter

SENSORS = ("odometry", "rfid")


def without_constants(log: Log, seed: int) -> Log:
    """Return the log with odometry that has white noise only (:func:`~factorgraph_loc.sensors.odometry.simulation.wheel_odometry`).

    The rig of the result has no uncertainty of the constants of wheels and antennas. Raises InputError if the log has no reference.
    """
    if log.reference is None:
        raise InputError(f"{log.name}: has no reference, from which odometry could be simulated")
    with patch.multiple(simulation, SCALE_SIGMA=0.0, DRIFT_SIGMA=0.0):
        wheels = simulation.wheel_odometry(log.reference, seed)
    odometry = log.rig.odometry.model_copy(update={"uncertainty": OdometryUncertainty()})
    return replace(
        log,
        rig=log.rig.model_copy(update={"odometry": odometry, "rfid": exact(log.rig.of(RfidSettings))}),
        streams={**log.streams, "odometry": wheels},
    )


def exact(settings: RfidSettings) -> RfidSettings:
    """Return the settings with detection models that have no uncertainty."""
    models = {
        name: m.model_copy(update={"prior": PriorSettings(range_scale=0.0, read_rate=0.0)})
        for name, m in settings.models.items()
    }
    return settings.model_copy(update={"models": models})


def optimal_filter(log: Log) -> Trajectory:
    """Run the optimal filter from the stated start of a log. Returns mean and covariance of the pose at each scan."""
    prior, _ = resolve_prior(log, "log")
    assert prior is not None
    diagnostics = Diagnostics()
    tags = KnownTags(Setup(log.rig, log.world, SENSORS, np.random.default_rng(0)), diagnostics)
    motion = Motion(log.rig, SENSORS, diagnostics, self_calibration=True)
    likelihood = tags.likelihood
    grid = GridFilter(prior, *extent(log.world, tags.surveyed))
    before = None
    t, means, covariances = [], [], []
    for m in log.measurements(SENSORS):
        if m.is_motion:
            motion.add(m)
            if before is None:
                before = motion.state(prior.t)
        elif isinstance(m, RfidScan) and before is not None and (looks := tags.read_counts(m)) is not None:
            state = motion.state(m.t)
            grid.predict(motion.relative(before, state))
            before = state
            mean, covariance = grid.moments()
            evidence = tags.weigh_states(looks, mean, se2.world_to_body(mean, covariance), likelihood.parameters)
            looks = tags.with_states(looks, evidence)
            tags.learn(m.t, evidence)
            grid.update(partial(_log_likelihood, likelihood, looks))
            mean, covariance = grid.moments()
            t.append(m.t)
            means.append(mean)
            covariances.append(covariance)
    return Trajectory(np.array(t), np.array(means).reshape(-1, 3), np.array(covariances).reshape(-1, 3, 3))


def _log_likelihood(likelihood: RfidLikelihood, looks: TagReadCounts, poses: Array) -> Array:
    # compute the exact likelihood: tables, as in the particle filter, would have errors
    return -likelihood.score(poses, looks).nll

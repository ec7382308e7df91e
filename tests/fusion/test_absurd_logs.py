"""Whatever a log holds, a run of it ends: in finite poses with positive covariances, or in one line that says why not."""

import numpy as np
import pytest
from absurd_logs import FAULTS, require_sound, verdict, whole

from factorgraph_loc.live.localizer import Localizer

# fewer particles than anybody takes, and so less to go on
SMALL = {"particles": 60, "smoothing_trajectories": 15, "min_particles": 20}
CONFIGS = {
    "dead_reckoning": ("dead_reckoning", {}),
    "ekf": ("ekf", {}),
    "ekf_unknown": ("ekf", {"landmarks": "unknown", "iterations": 5}),
    "particle_filter": ("particle_filter", SMALL),
    "particle_filter_kld": ("particle_filter", SMALL | {"kld": True}),
    "smoother": ("smoother", {}),
    "window": ("smoother", {"lag": 3.0}),
    "batch": ("batch", {}),
}
BEYOND = ("glitch_beyond_bounds", "clocks_years_apart")  # the bounds of their columns, or of a log's length


# each fault with one of the configurations, each configuration with several faults; tests/fuzz draws others
@pytest.mark.parametrize(
    ("fault", "config"), [(fault, list(CONFIGS)[i % len(CONFIGS)]) for i, fault in enumerate(FAULTS)]
)
def test_a_log_with_a_fault_is_survived(fault, config):
    rng = np.random.default_rng(sum(map(ord, fault + config)))
    name, settings = CONFIGS[config]
    # of some faults no sighting tells where a landmark is
    if config == "ekf_unknown" and fault in ("ranges_or_bearings_alone", "one_row_in_all"):
        settings = {}
    told = verdict(FAULTS[fault](whole(), rng), name, settings)
    assert told == ("refused" if fault in BEYOND else "ok")


@pytest.mark.parametrize(
    ("fault", "config"),
    [
        ("glitch_within_bounds", "dead_reckoning"),
        ("many_glitches", "particle_filter"),
        ("coincident_landmarks", "ekf"),
        ("tiny_sigmas", "ekf"),
    ],
)
def test_a_robot_that_drives_survives_them_too(fault, config):
    log = FAULTS[fault](whole(), np.random.default_rng(5))
    name, settings = CONFIGS[config]
    localizer = Localizer(log.rig, log.world, name, settings=settings)
    localizer.initialize(log.start.pose, np.diag(log.start.sigmas**2), log.start.t)
    for i, m in enumerate(log.measurements(("odometry", "bearing_range", "rfid"))):
        localizer.push(m)
        if i % 10 == 0:
            estimate = localizer.estimate()
            require_sound(estimate.pose[None], estimate.covariance[None])
    trajectory = localizer.trajectory()
    require_sound(trajectory.poses, trajectory.covariances)

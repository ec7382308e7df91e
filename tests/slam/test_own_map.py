"""A run without a map makes one, in which another drive finds its place and knows how well."""

from dataclasses import replace

import camera_world
import numpy as np
import pytest
from scipy.stats import chi2

from factorgraph_loc import World
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.output import map_of
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import cut

SECONDS = 24.0
SEEDS = range(21, 24)
UNKNOWN = RunConfig("smoother", {"landmarks": "unknown"})


def filmed(seed, speeds):
    """A drive through the room with features that are followed for four seconds, and no map."""
    return camera_world.with_tracks(
        camera_world.simulate(seed, SECONDS, speeds=speeds), 4.0, seed, begin=0.3, every=0.4
    )


@pytest.fixture(scope="module")
def days():
    """Of each seed the map of a first drive, and the log of a second one in it."""
    found = {}
    for seed in SEEDS:
        monday, tuesday = filmed(seed, camera_world.circle), filmed(seed + 100, camera_world.weave)
        found[seed] = replace(tuesday, world=map_of(run(monday, UNKNOWN), monday))
    return found


@pytest.mark.parametrize("name", ["smoother", "monoslam"])
def test_the_error_of_the_map_is_in_the_covariances(days, name):
    """Within one drive it is nearly the same all the time: each drive counts for one pose. False alarm: one in a thousand."""
    found = [score(run(log, RunConfig(name)), log) for log in days.values()]
    low, high = chi2.ppf((0.0005, 0.9995), 3 * len(found)) / len(found)
    for kind in ("causal", "final"):
        assert low < np.mean([one[f"{kind}.anees"] for one in found]) < high
        assert np.sqrt(np.mean([one[f"{kind}.position_rmse"] ** 2 for one in found])) < 0.25


def test_what_the_map_may_be_wrong_by_is_told_once(days):
    log = cut(days[SEEDS[0]], 0.0, 5.0)
    (told,) = (w for w in run(log, RunConfig("ekf")).warnings if w.kind == "bent_map")
    assert told.fields["median"] < 1.0
    others = (RunConfig("dead_reckoning", sensors=("odometry",)), UNKNOWN)
    assert not any(w.kind == "bent_map" for config in others for w in run(log, config).warnings)


def test_points_are_known_from_several_sides(days):
    points = days[SEEDS[0]].world.points
    counts = np.bincount(points.owners, minlength=len(points))
    assert counts.min() == 1
    assert 2 <= counts.max() <= 4
    twice = np.flatnonzero(counts >= 2)
    apart = [np.ptp(points.seen_from[points.owners == i], axis=0).max() for i in twice.tolist()]
    assert np.median(apart) > 0.3  # m, after 0.5 m of the way


def test_points_that_a_map_lacks_are_added_to_it(days):
    log = cut(days[SEEDS[0]], 0.0, 12.0)
    half = np.flatnonzero(log.world.points.positions[:, 0] < 0.0)
    known = replace(log, world=World(points=log.world.points.chosen(half)))
    found = map_of(run(known, RunConfig("smoother", {"landmarks": "extended"})), known)
    assert set(known.world.points.names) <= set(found.points.names)
    assert len(found.points) > len(half) + 10
    assert map_of(run(log, RunConfig("smoother")), log) is None

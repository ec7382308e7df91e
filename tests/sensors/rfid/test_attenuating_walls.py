"""Walls that attenuate: simulated reads, calibration and estimates."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.maps.free_space import crosses
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.rfid.calibration.fit import Floor
from factorgraph_loc.sensors.rfid.calibration.pairs import pairs_of
from factorgraph_loc.sensors.rfid.calibration.refit import refit_beam
from factorgraph_loc.sensors.rfid.calibration.rounds import rounds_of
from factorgraph_loc.sensors.rfid.settings import SurveySettings
from factorgraph_loc.sensors.rfid.tag_map import tag_map
from factorgraph_loc.simulation import preset, simulate
from factors.rfid.model import BeamModel


@cache
def office(attenuation: float | None = 4.0) -> Log:
    changes = {"drive": {"duration": 120.0}, "world": {"wall_attenuation": attenuation}}
    return simulate(preset("office", changes), 21)


def untold(log: Log) -> Log:
    return replace(log, world=log.world.model_copy(update={"wall_attenuation": None}))


def test_reads_through_walls_are_as_many_as_from_farther_away():
    """The rule written out once more, with every wall of the map. Within five standard deviations, a false alarm in two million;
    without walls they would be half as many again."""
    log, beam = office(), BeamModel()
    places = tag_map(log.world, log.rig.survey).tags.points[:, :2]
    expected, variance, without = 0.0, 0.0, 0.0
    for pose in log.reference.at(np.arange(1, 241) * 0.5):
        for yaw in pose[2] + np.arange(8) * np.pi / 4.0:
            at = pose[:2] + 0.25 * np.array((np.cos(yaw), np.sin(yaw)))
            away, ends = places - at, np.broadcast_to(at, places.shape)
            count = sum(crosses(World(walls=(wall,)), ends, places).astype(float) for wall in log.world.walls)
            bearing = np.remainder(np.arctan2(away[:, 1], away[:, 0]) - yaw + np.pi, 2.0 * np.pi) - np.pi
            lobe = beam.p0 * np.exp(-0.5 * (bearing / beam.sigma_phi) ** 2)
            near, far = (np.hypot(*away.T) * 10.0 ** (4.0 * c / 20.0) for c in (0.0, count))
            p = 1e-3 + 0.999 * lobe / (1.0 + np.exp((np.minimum(far, 50.0) - beam.r_max) / beam.s_r))
            expected, variance = expected + p.sum(), variance + np.sum(p * (1.0 - p))
            without += np.sum(1e-3 + 0.999 * lobe / (1.0 + np.exp((near - beam.r_max) / beam.s_r)))
    reads = sum(bool(epc) for epc in log.streams["rfid"].epc)
    assert abs(reads - expected) < 5.0 * np.sqrt(variance)
    assert without > 1.4 * expected


def test_calibration_sees_through_the_walls_that_the_map_tells_of():
    """Within four standard errors, a false alarm in 16,000; a map that tells of no walls makes the range shorter than it is."""
    for log, right in ((office(), True), (untold(office()), False)):
        rounds = rounds_of(log, log.rig.rfid)
        found = refit_beam(pairs_of([rounds], log.rig.rfid, SurveySettings()), Floor(1e-3, 1e-3), BeamModel())
        i = found.names.index("r_max")
        assert (abs(found.values[i] - 4.5) < 4.0 * found.errors[i]) == right, (found.values, found.errors)


@pytest.mark.parametrize("estimator", ["ekf", "smoother", "particle_filter"])
def test_told_of_walls_an_estimator_is_as_good_as_without_them(estimator):
    settings = {"particles": 2000} if estimator == "particle_filter" else {}

    def error(log: Log) -> float:
        return score(run(log, RunConfig(estimator, settings)), log)["causal.position_rmse"]

    told, open_, misled = error(office()), error(office(None)), error(untold(office()))
    assert told < 1.2 * open_
    assert told < 0.5 * misled

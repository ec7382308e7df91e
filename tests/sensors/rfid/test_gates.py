"""Readers that are fixed in the building, and a robot with tags."""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refusal

from factorgraph_loc.evaluation.inspect import inspect
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.interfaces import marks
from factorgraph_loc.sensors.rfid.stream import RfidStream
from factorgraph_loc.simulation import preset, simulate


@pytest.fixture(scope="module")
def gates() -> Log:
    return simulate(preset("gates", {"drive": {"duration": 90.0}}), 2)


def error(log: Log, **settings) -> float:
    """The causal error of the position [m]."""
    return score(run(log, RunConfig(**settings)), log)["causal.position_rmse"]


@pytest.mark.parametrize("estimator", ["ekf", "smoother", "particle_filter"])
def test_all_estimators_localize_a_robot_by_antennas_at_doors(gates: Log, estimator: str) -> None:
    assert error(gates, estimator=estimator) < 0.25 < error(gates, estimator="dead_reckoning")


def test_an_unknown_start_is_found(gates: Log) -> None:
    result = run(gates, RunConfig("particle_filter", prior="unknown"))
    assert gates.reference is not None
    localized = np.array(result.status) == "localized"
    off = np.hypot(*(result.poses[localized, :2] - gates.reference.at(result.t[localized])[:, :2]).T)
    assert localized[result.t > 60.0].all()
    assert np.sqrt(np.mean(off**2)) < 0.4


def test_without_empty_rounds_reads_still_inform(gates: Log) -> None:
    stream = gates.streams["rfid"]
    assert isinstance(stream, RfidStream)
    rows = np.array([bool(epc) for epc in stream.epc])
    columns = {name: getattr(stream, name)[rows] for name in ("t", "round", "age", "rssi", "phase", "frequency")}
    names = {name: [x for x, is_read in zip(getattr(stream, name), rows) if is_read] for name in ("antenna", "epc")}  # noqa: B905
    reads = replace(gates, streams={**gates.streams, "rfid": replace(stream, **columns, **names)})
    assert error(reads, estimator="smoother") < 0.6


def test_a_dead_tag_on_the_robot_is_named() -> None:
    log = simulate(preset("gates", {"drive": {"duration": 90.0}, "faults": {"dead": 0.5}}), 2)
    result = run(log, RunConfig("smoother"))
    assert list(result.diagnostics.doubted["dead_tags"]) == log.metadata["dead"].split(", ")
    assert not result.diagnostics.doubted["moved_tags"]
    assert any("1 of 2 tags on the robot" in str(warning) for warning in result.warnings)


def test_summary_and_plots_show_the_antennas_of_the_map(gates: Log) -> None:
    found = inspect(gates)
    assert found.problems == ()
    (shown,) = (each for each in marks(gates) if each.layer == "antennas")
    assert shown.names == tuple(gates.world.antennas)
    assert set(shown.seen) <= set(shown.names)


def without(log: Log, **world: object) -> Log:
    return replace(log, world=log.world.model_copy(update=world))


def test_what_does_not_fit_is_refused_with_what_to_type(gates: Log) -> None:
    def refused(log: Log, *words: str, sensors: tuple[str, ...] | None = None) -> None:
        refusal(lambda: run(log, RunConfig("ekf", sensors=sensors)), *words)

    antennas = gates.world.antennas
    refused(without(gates, antennas={}), "the map has no antennas", "[antennas.NAME]")
    fewer = {name: antenna for name, antenna in antennas.items() if name != "A003"}
    refused(without(gates, antennas=fewer), "antenna 'A003' is not in the map", "add [antennas.'A003']")
    unknown = {**antennas, "A003": antennas["A003"].model_copy(update={"model": "narrow"})}
    refused(without(gates, antennas=unknown), "A003", "'narrow'", "[rfid.models]", "default")
    office = simulate(preset("office", {"drive": {"duration": 2.0}}), 2)
    tag = next(iter(office.world.tags.values()))
    refused(without(gates, tags={"front": tag}), "tag 'front' is on the robot", "also in the map")
    on_robot = gates.rig.model_copy(update={"rfid": office.rig.rfid})
    refused(replace(gates, rig=on_robot), "'A000' is fixed in the map", "[rfid.tags.EPC]")
    stream = gates.streams["rfid"]
    strong = replace(gates, streams={**gates.streams, "rfid": replace(stream, rssi=np.full(len(stream.t), -50.0))})
    refused(strong, "rssi needs antennas on the robot", "--sensors", sensors=("odometry", "rfid", "rssi"))
    refusal(lambda: preset("gates", {"phase": {}}), "phase", "antennas on the robot")

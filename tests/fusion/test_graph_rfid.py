"""Smoother and batch with scans of RFID tags, on simulated offices."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from by_hand import made

from factorgraph_loc import IncrementOdometry, IncrementStream, Log, RfidScan, Tick
from factorgraph_loc.evaluation.metrics import errors, score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.model.log import cut, join
from factorgraph_loc.simulation import preset, simulate

DURATION = 80.0


def office(faults: Mapping[str, Any] | None = None, seed: int = 1, **changes: Any) -> Log:
    settings = {"drive": {"duration": DURATION}, "faults": dict(faults or {}), **changes}
    return simulate(preset("office", settings), seed)


def test_landmarks_of_a_track_that_was_lost_are_forgotten() -> None:
    """The odometry jumps by 8 m; tags tell it once, and landmarks that were put to where they seemed to be do not lead back."""
    seen = {"max_range": 6.0, "rate": 5.0}
    log = office({}, 3, drive={"duration": 26.0}, world={"tags": 60, "landmarks": 30}, sightings=seen)
    odometry = log.streams["odometry"]
    assert isinstance(odometry, IncrementStream)
    way = odometry.dx + 8.0 * (np.arange(len(odometry.t)) == np.searchsorted(odometry.t, 20.0))
    carried = replace(log, streams={**log.streams, "odometry": replace(odometry, dx=way)})
    sensors = ("odometry", "rfid", "bearing_range")
    result = run(carried, RunConfig("smoother", {"landmarks": "unknown"}, sensors=sensors))
    (lost,) = [event for event in result.diagnostics.events if event.kind == "lost"]
    assert abs(lost.fields["since"] - 20.0) < 0.05
    assert score(result, log)["final.position_rmse"] < 0.15


def test_a_robot_that_is_carried_far() -> None:
    """The way that it is carried tells nothing of the odometry's constants, and these nothing of that way."""
    hall = {"world": {"width": 60.0, "depth": 36.0, "tags": 180}, "drive": {"duration": 20.0}}
    world = preset("warehouse", hall).model_copy(update={"world_seed": 1})
    carried = join(cut(simulate(world, 10), 0.0, 12.0), cut(simulate(world, 11), 0.0, 14.0))
    result = run(carried, RunConfig("smoother"))
    (lost,) = result.diagnostics.events
    assert lost.kind == "lost"
    causal = errors(result.causal(), carried.reference)
    assert np.nanmax(causal.position[causal.t > lost.t]) < 0.6
    assert np.nanmax(errors(result.final, carried.reference).position) < 0.5


def test_belief_while_it_seeks_has_particles_that_move_with_the_odometry() -> None:
    log = office()
    sensors = ("odometry", "rfid")
    smoother = made("smoother", log.rig, log.world, sensors, 1)
    assert smoother.belief().particles is None
    scans = 0
    for m in log.measurements(sensors):
        smoother.process(m)
        scans += isinstance(m, RfidScan)
        if scans == 2:
            break
    end = m.t + 2.0
    smoother.process(IncrementOdometry(end, 0.0, 0.0, 0.0))
    for t in np.arange(m.t + 0.1, end + 0.05, 0.1):  # the search goes on in slices
        smoother.process(Tick(t))
    first = smoother.belief()
    assert first.particles is not None
    assert first.weights is not None
    assert np.isclose(first.weights.sum(), 1.0)
    middle = first.modes[0].pose
    near = np.hypot(*(first.particles - middle)[:, :2].T) < 3.0
    assert first.weights[near].sum() > 0.3 * first.modes[0].weight
    smoother.process(IncrementOdometry(end + 0.4, 0.2, 0.0, 0.0))
    smoother.process(Tick(end + 0.4))
    moved = smoother.belief().particles
    assert moved is not None
    assert np.allclose(np.hypot(*(moved - first.particles)[:, :2].T), 0.2, atol=0.02)

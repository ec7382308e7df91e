"""Conversion of logs with odometry and landmarks to plain numbers for reference programs, and the log of the quick benchmark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from factorgraph_loc.experiments.preparation import resolve_prior
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.landmarks.measurement import BearingRange, BearingRangeSettings
from factorgraph_loc.sensors.motion import odometry_model, whole_motion
from factorgraph_loc.sensors.odometry.settings import OdometrySettings
from factorgraph_loc.simulation import preset, simulate
from factors.landmarks.model import located, sigmas
from factors.se2 import Array
from landmarks_benchmark.programs.plain import Problem

SENSORS = ("odometry", "bearing_range")
TICK = 0.1  # s
SEED = 5
RIG = {
    "odometry": {"uncertainty": {"heading_rate_bias": 0.001}},
    "bearing_range": {
        "x": -0.025,
        "range_kind": "depth",
        "range_sigma": 0.04,
        "range_sigma_relative": 0.02,
        "bearing_sigma": 0.016,
        "uncertainty": {"x": 0.01, "bearing_bias": 0.003, "range_scale": 0.006, "depth_axis": 0.025},
    },
}
SIGHTINGS = {"rate": 5.0, "field_of_view": 1.2}


def landmark_log(seconds: float) -> Log:
    """Simulate a drive of ``seconds`` [s] through an office with landmarks on its walls. A camera measures their depth and
    bearing."""
    world = {"tags": 1, "landmarks": 30}
    settings = {"world": world, "drive": {"duration": seconds}, "rig": RIG, "sightings": SIGHTINGS}
    log = simulate(preset("office", settings), SEED)
    streams = {name: log.streams[name] for name in SENSORS}  # no tags
    return replace(log, streams=streams, rig=log.rig.model_copy(update={"sensors": SENSORS}))


def problem_of(log: Log) -> Problem:
    """Convert a log with odometry, landmarks at known positions, and a reference to plain numbers."""
    prior, _ = resolve_prior(log, None)
    assert prior is not None
    assert log.reference is not None
    seen, raw = _sightings(log, prior.t)
    rows = log.streams["odometry"].t + log.rig.time_offset("odometry")
    end = max(float(rows.max()), float(seen[:, 0].max()))
    ticks: Array = prior.t + TICK * np.arange(math.floor((end - prior.t) / TICK) + 1, dtype=float)
    odometry, sensor = log.rig.of(OdometrySettings), log.rig.of(BearingRangeSettings)
    model, u = odometry_model(log.rig), sensor.uncertainty
    growth = (model.along.per_distance, model.lateral.per_distance, model.heading.per_distance)
    return Problem(
        start=prior.t,
        pose=np.array(prior.pose),
        covariance=np.array(prior.covariance),
        moves=_moves(log, np.unique(np.concatenate((rows[rows >= prior.t], seen[:, 0], ticks)))),
        sightings=seen,
        raw=raw,
        ticks=ticks,
        growth=np.square((*growth, model.heading.per_rotation)),
        sensor=np.array((sensor.x, sensor.range_scale)),
        constants=np.array((odometry.uncertainty.heading_rate_bias, u.x, u.bearing_bias, u.range_scale, u.depth_axis)),
        reference_t=log.reference.t,
        reference=log.reference.poses,
    )


def _moves(log: Log, stamps: Array) -> Array:
    """Return the motions (N, 4) between consecutive ``stamps``: end [s], duration [s], speed [m/s] and turn rate [rad/s]."""
    motion = whole_motion(log, SENSORS)
    states = [motion.state(t) for t in stamps.tolist()]
    moves = []
    for a, b in pairwise(states):
        forward = math.cos(a.heading) * (b.x - a.x) + math.sin(a.heading) * (b.y - a.y)
        duration = b.t - a.t
        speed = math.copysign(b.path - a.path, forward) / duration
        moves.append((b.t, duration, speed, (b.heading - a.heading) / duration))
    return np.array(moves)


def _sightings(log: Log, start: float) -> tuple[Array, Array]:
    """Return the arrays ``sightings`` and ``raw`` of :class:`Problem`, for measurements from the time ``start`` [s] on."""
    model = log.rig.of(BearingRangeSettings).model()
    seen: list[Sequence[float]] = []
    raw: list[Sequence[float]] = []
    for m in log.measurements(SENSORS):
        if not isinstance(m, BearingRange) or m.t < start:
            continue
        places, spread = located(model, m.range, m.bearing), sigmas(model, m.range)
        for name, place, sigma, reported in zip(
            m.landmarks, places, spread, np.column_stack((m.range, m.bearing)), strict=True
        ):
            known = log.world.landmarks.get(name)
            if known is None:
                continue
            scale = model.range_scale * (math.cos(reported[1]) if model.depth else 1.0)
            range_, bearing = math.hypot(*place), math.atan2(place[1], place[0])
            seen.append((m.t, known.x, known.y, range_, bearing, sigma[0] / scale, sigma[1]))
            raw.append((*reported, *sigma))
    return np.array(seen), np.array(raw)

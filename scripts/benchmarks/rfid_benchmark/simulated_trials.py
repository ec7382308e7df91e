"""Trials of an unknown start and of kidnapping on simulated logs, each in a new world, evaluated over time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from time import process_time
from typing import Literal

import numpy as np
from benchmarking.statistics import first_held
from benchmarking.trials import BEFORE, HOLD, JUMP, POSITION, is_right

from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.fusion.base import Estimator
from factorgraph_loc.fusion.tracking import beyond
from factorgraph_loc.model.log import Log, cut, join
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.simulation import simulate
from factorgraph_loc.simulation.settings import SimulationSettings

AWAY = 3.0  # m, least displacement of a kidnapping
APART = 60.0  # s between the parts of a log that a kidnapping joins

Kind = Literal["unknown start", "kidnapping"]


@dataclass(frozen=True)
class SimulatedTrial:
    """One trial. ``seconds``: from the first scan (at the new place) until the estimate is correct and stays so for 10 s,
    whatever its status; ``claimed``: until it first is ``localized`` (correct and localized again, after a kidnapping); NaN if
    never. ``false``: the first claim is wrong; after a kidnapping: it is localized at the deadline without being correct.
    ``doubt``: the probability by its covariance, at the first claim, that its position is farther off than is right.
    ``busy_ms``: processor time of each tenth of a second of the log, which holds at most one scan of the presets."""

    seed: int
    seconds: float
    claimed: float
    false: bool
    doubt: float = math.nan
    busy_ms: tuple[float, ...] = ()


class Clock:
    """Processor time between the ticks of a run."""

    def __init__(self) -> None:
        self._last = process_time()
        self.busy_ms: list[float] = []

    def __call__(self, t: float, estimator: Estimator) -> None:
        now = process_time()
        self.busy_ms.append(1e3 * (now - self._last))
        self._last = now


def run_simulated_trials(
    kind: Kind, simulation: SimulationSettings, estimator: str, deadline: float, seeds: Sequence[int]
) -> list[SimulatedTrial]:
    """Trials of a kind, one with each of the seeds; ``deadline`` [s]."""
    trial = start_trial if kind == "unknown start" else kidnapping_trial
    return [trial(simulation, estimator, deadline, seed) for seed in seeds]


def start_trial(simulation: SimulationSettings, estimator: str, deadline: float, seed: int) -> SimulatedTrial:
    """The beginning of a drive, from an unknown start, long enough to hold a correct estimate at three deadlines."""
    return started(simulate(lasting(simulation, 3.0 * deadline + HOLD + 1.0), seed), estimator, seed)


def started(log: Log, estimator: str, seed: int) -> SimulatedTrial:
    """The trial on the log of such a drive."""
    clock = Clock()
    result = run(log, RunConfig(estimator, prior="unknown", seed=seed), watch=clock)
    first = float(log.streams["rfid"].t[0])
    good = is_right(result, log)
    claims = np.flatnonzero(np.array(result.status) == "localized")
    claimed = float(result.t[claims[0]]) - first if len(claims) else math.nan
    false = bool(len(claims)) and not bool(good[claims[0]])
    doubt = beyond(result.covariances[claims[0]], POSITION) if len(claims) else math.nan
    # without the first, which begins before the run
    return SimulatedTrial(seed, held(result, good, first), claimed, false, doubt, tuple(clock.busy_ms[1:]))


def kidnapping_trial(simulation: SimulationSettings, estimator: str, deadline: float, seed: int) -> SimulatedTrial:
    """A robot that drives from a known start and is then moved to its position a minute later, or the first one after that which
    is 3 m away."""
    after = 3.0 * deadline + HOLD + 1.0
    log = simulate(lasting(simulation, BEFORE + 2.0 * APART + after), seed)
    assert log.reference is not None
    here = log.reference.at(np.array([BEFORE]))[0]
    later = (log.reference.t >= BEFORE + APART) & (log.reference.t <= BEFORE + 2.0 * APART)
    away = later & (np.hypot(*(log.reference.poses[:, :2] - here[:2]).T) >= AWAY)
    other = float(log.reference.t[np.argmax(away if away.any() else later)])
    before = cut(log, 0.0, BEFORE)
    carried = join(before, cut(log, other, other + after), gap=JUMP)
    result = run(carried, RunConfig(estimator, prior="reference", seed=seed))
    stamps = carried.streams["rfid"].t
    first = float(stamps[stamps > max(before.streams["rfid"].t)][0])
    good = is_right(result, carried)
    seconds = held(result, good, first)
    localized = np.array(result.status) == "localized"
    at_deadline = int(np.searchsorted(result.t, first + deadline).clip(max=len(result.t) - 1))
    late = not seconds <= deadline
    false = late and bool(localized[at_deadline]) and not bool(good[at_deadline])
    return SimulatedTrial(seed, seconds, held(result, good & localized, first), false)


def held(result: RunResult, good: np.typing.NDArray[np.bool_], first: float) -> float:
    """Seconds from ``first`` until ``good`` (N,) holds."""
    later = result.t >= first - 1e-9
    return first_held(result.t[later], good[later], HOLD) - first


def lasting(settings: SimulationSettings, duration: float) -> SimulationSettings:
    return settings.model_copy(update={"drive": settings.drive.model_copy(update={"duration": duration})})

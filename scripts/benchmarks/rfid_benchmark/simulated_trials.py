"""Trials of an unknown start and of kidnapping on simulated logs. Each trial is in a new world."""

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

AWAY = 3.0  # m: least displacement of a kidnapping
APART = 60.0  # s between the two parts of a log that are joined to simulate a kidnapping

Kind = Literal["unknown start", "kidnapping"]


@dataclass(frozen=True)
class SimulatedTrial:
    """The result of one trial. Times begin at the first scan; after a kidnapping, at the first scan at the new place.

    ``seconds`` [s]: the time until the estimate is correct for 10 s, whatever its status. NaN if it never is.
    ``claimed`` [s]: the time until the first estimate with the status localized. After a kidnapping, until the estimate is
    correct and localized again. NaN if this never happens.
    ``false``: True if the first localized estimate is wrong. After a kidnapping: True if the estimate is localized at the
    deadline, but not correct.
    ``doubt``: the probability that the first localized estimate is wrong, according to its covariance.
    ``busy_ms``: the processor time of each tenth of a second of the log. It contains at most one scan.
    """

    seed: int
    seconds: float
    claimed: float
    false: bool
    doubt: float = math.nan
    busy_ms: tuple[float, ...] = ()


class Clock:
    """Measures the processor time between the ticks of a run. It is passed to the run as ``watch``."""

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
    """Run a trial with each of the ``seeds``. ``deadline`` [s]: for a correct estimate."""
    trial = start_trial if kind == "unknown start" else kidnapping_trial
    return [trial(simulation, estimator, deadline, seed) for seed in seeds]


def start_trial(simulation: SimulationSettings, estimator: str, deadline: float, seed: int) -> SimulatedTrial:
    """Simulate the beginning of a drive, and run an estimator with an unknown start. The log lasts three times the ``deadline``
    [s]."""
    return started(simulate(lasting(simulation, 3.0 * deadline + HOLD + 1.0), seed), estimator, seed)


def started(log: Log, estimator: str, seed: int) -> SimulatedTrial:
    """Run an estimator with an unknown start on a log, and return the result of the trial."""
    clock = Clock()
    result = run(log, RunConfig(estimator, prior="unknown", seed=seed), watch=clock)
    first = float(log.streams["rfid"].t[0])
    good = is_right(result, log)
    claims = np.flatnonzero(np.array(result.status) == "localized")
    claimed = float(result.t[claims[0]]) - first if len(claims) else math.nan
    false = bool(len(claims)) and not bool(good[claims[0]])
    doubt = beyond(result.covariances[claims[0]], POSITION) if len(claims) else math.nan
    # without the first time, which includes the time before the run
    return SimulatedTrial(seed, held(result, good, first), claimed, false, doubt, tuple(clock.busy_ms[1:]))


def kidnapping_trial(simulation: SimulationSettings, estimator: str, deadline: float, seed: int) -> SimulatedTrial:
    """Simulate a kidnapping, and run an estimator with a known start. The robot is moved to the first later pose of the drive
    that is at least a minute later and 3 m away."""
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
    """Return the time [s] from ``first`` [s] until the estimates are ``good`` (N,) for 10 s, or NaN if they never are."""
    later = result.t >= first - 1e-9
    return first_held(result.t[later], good[later], HOLD) - first


def lasting(settings: SimulationSettings, duration: float) -> SimulationSettings:
    return settings.model_copy(update={"drive": settings.drive.model_copy(update={"duration": duration})})

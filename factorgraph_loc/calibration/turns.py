"""Calibration without a reference: smoothing and learning by turns.

Each turn smooths the logs with the rig at hand, and learns from the smoothed trajectories, with their covariances, what the rig
should have been: expectation-maximisation (Dempster, Laird and Rubin, JRSS B 39, 1977; with a smoother: Shumway and Stoffer,
"An approach to time series smoothing and forecasting using the EM algorithm", 1982). It ends when a turn changes nothing by more
than a fraction of its standard error.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factorgraph_loc.calibration.learn import Knowledge, calibrators, learn
from factorgraph_loc.errors import InputError
from factorgraph_loc.fitting.posterior import FittedConstant
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.smoothed import Traced

Smooth = Callable[[Log], RunResult]
"""Runs the smoother on a log, with the log's rig."""

TURNS = 8
SETTLED = 0.3  # standard errors that the last turn may change
TOO_VAGUE = 1.0  # m; from a trajectory that is known less well nothing is learnt


@dataclass(frozen=True)
class Turns:
    """What was learnt: the ``knowledge``, and by how many standard errors each turn ``changed`` it at most."""

    knowledge: Knowledge
    changed: tuple[float, ...]

    @property
    def settled(self) -> bool:
        """Whether the last turn changed next to nothing."""
        return self.changed[-1] < SETTLED

    @property
    def doubts(self) -> tuple[str, ...]:
        """Warnings, one line each."""
        if self.settled:
            return self.knowledge.notes
        return (
            *self.knowledge.notes,
            f"The last of {len(self.changed)} turns still changed a value by {self.changed[-1]:.1f} standard errors: the logs "
            "hardly tell it.",
        )


def learn_by_turns(
    logs: Sequence[Log],
    start: Rig,
    smooth: Smooth,
    grids: Path | None = None,
    progress: Callable[[float, float], None] | None = None,
) -> Turns:
    """Learn a rig from ``logs``, whose references are not used, beginning with the rig ``start``.

    ``grids``: path prefix of files that may be written; ``progress``: called with the number of runs done and of all that there
    may be. InputError if a log does not tell enough.
    """
    rig, changed = start, list[float]()
    before: Mapping[tuple[str, str], float] = {}
    while True:
        for calibrator in calibrators().values():
            rig = calibrator.widened(rig, start)
        smoothed = []
        for log in logs:
            smoothed.append(_smoothed(replace(log, rig=rig, reference=None), smooth))
            if progress is not None:
                progress(len(changed) * len(logs) + len(smoothed), TURNS * len(logs))
        knowledge = learn(smoothed, rig, start, grids)
        if not knowledge.constants and not knowledge.notes:
            raise InputError(
                f"{logs[0].name}: nothing of the rig {start.name} can be learnt without a reference: it has no detection model, "
                "and no constant with an uncertainty, that the log's sensors use"
            )
        rig = knowledge.rig
        changed.append(max((_change(one, before) for one in knowledge.constants), default=0.0))
        before = {(one.sensor, one.name): one.fitted for one in knowledge.constants}
        if len(changed) == TURNS or changed[-1] < SETTLED:
            return Turns(knowledge, tuple(changed))


def _smoothed(log: Log, smooth: Smooth) -> Traced:
    """The log with its smoothed trajectory as reference."""
    result = smooth(log)
    final = result.final
    if result.first_localized() is None or len(final) < 2 or final.covariances is None:
        raise InputError(
            f"{log.name}: the smoother did not localize the robot, so that nothing can be learnt without a reference"
        )
    vague = float(np.sqrt(np.median(np.trace(final.covariances[:, :2, :2], axis1=1, axis2=2))))
    if vague > TOO_VAGUE:
        raise InputError(
            f"{log.name}: the smoother knows the robot's place to {vague:.1f} m only (median), expected {TOO_VAGUE:g} m or less "
            "to learn from it without a reference"
        )
    doubted = frozenset[str]().union(*result.diagnostics.doubted.values())
    return Traced(replace(log, reference=final), result.learnt.values, doubted)


def _change(one: FittedConstant, before: Mapping[tuple[str, str], float]) -> float:
    """How far a constant went in a turn, in its standard errors."""
    way = abs(one.fitted - before.get((one.sensor, one.name), one.before))
    return way / one.error if way > 0.0 else 0.0

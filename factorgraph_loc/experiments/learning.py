"""A run with a final trajectory for a rig that is learnt from the log.

The learnt rig depends on the whole log. Causal estimates therefore use the given rig.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter

from factorgraph_loc.calibration.learn import Knowledge
from factorgraph_loc.calibration.turns import TURNS, learn_by_turns
from factorgraph_loc.experiments.preparation import used_sensors
from factorgraph_loc.experiments.run import run
from factorgraph_loc.files.temporary import of_system, temporary_folder
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.model.scoring import RunConfig

SMOOTHER = "smoother"


@dataclass(frozen=True)
class LearningRun:
    """A ``result`` whose final trajectory is that of the learnt rig; all else in it is of the given rig. ``knowledge``: the result
    of learning."""

    result: RunResult
    knowledge: Knowledge


def run_and_learn(log: Log, config: RunConfig, progress: Callable[[float], None] | None = None) -> LearningRun:
    """Run an estimator on a log, learn the rig from the log by turns with the smoother, and compute the final trajectory with it.

    ``progress`` is called with the fraction done. The effective configuration of the result has the ``learnt_rig`` too. Raises
    InputError if the log has too little information, and the errors of :func:`~factorgraph_loc.experiments.run.run`.
    """
    report = progress or (lambda _share: None)
    runs = TURNS + 2
    given = run(log, config, lambda share: report(share / runs))
    settings = config.settings if config.estimator == SMOOTHER else {}
    smoothing = replace(config, estimator=SMOOTHER, settings=settings)
    start = log.rig.model_copy(update={"sensors": used_sensors(log, config.sensors)})
    started = perf_counter()
    with temporary_folder(of_system("grids")) as folder:
        knowledge = learn_by_turns(
            [log],
            start,
            lambda learnt_log: run(replace(log, rig=learnt_log.rig), smoothing),
            folder / "learnt",
            lambda done, _all: report((1.0 + done) / runs),
        )
        rig = knowledge.rig
        again = run(replace(log, rig=rig), config)
    report(1.0)
    return LearningRun(
        replace(
            given,
            config={**given.config, "learnt_rig": rig.model_dump(mode="json", exclude_none=True)},
            final=again.final,
            timings=replace(given.timings, final_seconds=perf_counter() - started),
            warnings=(*given.warnings, *knowledge.notes),
        ),
        knowledge,
    )

"""The command ``fgloc run`` as a function."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from factorgraph_loc.calibration.learn import TURNS, Knowledge, learn_by_turns
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.evaluation.plots import write_plots
from factorgraph_loc.experiments import output
from factorgraph_loc.experiments import run as running
from factorgraph_loc.experiments.compare import summary_text
from factorgraph_loc.experiments.preparation import used_sensors
from factorgraph_loc.files.temporary import of_system, require_free, temporary_folder
from factorgraph_loc.fitting.posterior import FittedConstant
from factorgraph_loc.io.readers import LogLike, RigLike, WorldLike, read_log
from factorgraph_loc.io.results import FILES
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.model.scoring import MAX_GAP, TICK_GAP, Alignment, RunConfig

SMOOTHER = "smoother"


@dataclass(frozen=True)
class Run:
    """The estimates of one estimator on one log, and their scores.

    ``result``: the estimates. ``scores``: the scores, as in ``metrics.json``. ``learnt``: the constants of the rig that
    were estimated from the log, empty unless requested.
    """

    result: RunResult
    scores: dict[str, Any]
    learnt: tuple[FittedConstant, ...] = ()

    def __repr__(self) -> str:
        done = {"log": self.result.log, "estimator": self.result.config["estimator"], "status": "ok"}
        return summary_text([done | self.scores])


def run(
    log: LogLike,
    estimator: str,
    *,
    settings: Mapping[str, Any] | None = None,
    sensors: Sequence[str] | None = None,
    prior: str | None = None,
    seed: int = 0,
    rig: RigLike | None = None,
    world: WorldLike | None = None,
    max_gap: float = MAX_GAP,
    tick_gap: float = TICK_GAP,
    learn: bool = False,
    align: Alignment = "none",
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Run:
    """Run one estimator on one log. Return the estimates and their scores.

    ``settings``: values that replace settings of the estimator. ``sensors``: names of the sensors to use. ``prior``:
    the start pose, "X,Y,HEADING" or a name such as "reference". ``seed``: the seed of the random generator. ``learn``:
    estimate the constants of the rig from the log itself. Only the final trajectory uses these estimates. ``align``:
    unless it is "none", there are also scores after this alignment with the reference trajectory. ``out``: a folder for
    the files of ``fgloc run``. ``progress`` is called with the fraction of the work that is done. ``rig``, ``world``:
    replace those of the log. ``max_gap`` [s]: longest gap between estimates that scoring interpolates. ``tick_gap``
    [s]: no estimates are recorded in longer gaps between measurements.
    """
    if out is not None:
        require_free(Path(out), FILES, overwrite=overwrite)
    loaded = read_log(log, rig=rig, world=world)
    config = RunConfig(
        estimator, settings or {}, None if sensors is None else tuple(sensors), prior, seed, max_gap, tick_gap
    )
    learnt: tuple[FittedConstant, ...] = ()
    if learn:
        result, knowledge = run_and_learn(loaded, config, progress)
        learnt = tuple(knowledge.constants)
    else:
        result = running.run(loaded, config, progress)
    if out is None:
        return Run(result, score(result, loaded, align), learnt)
    scores = output.save_run(result, loaded, Path(out), align=align, overwrite=overwrite)
    write_plots(result, loaded, Path(out))
    return Run(result, scores, learnt)


def run_and_learn(
    log: Log, config: RunConfig, progress: Callable[[float], None] | None = None
) -> tuple[RunResult, Knowledge]:
    """Return the result of a run on a log, and the rig that is estimated from the same log.

    The rig, the settings of a robot and its sensors, is estimated from the whole log. Therefore only the final
    trajectory uses the estimated rig, and causal estimates use the given rig. ``config``: the estimator and its
    settings. The configuration in the result has the estimated rig as ``learnt_rig``. ``progress`` is called with the
    fraction of the work that is done. Raises InputError if the log has too little information.
    """
    report = progress or (lambda _share: None)
    runs = TURNS + 2
    given = running.run(log, config, lambda share: report(share / runs))
    settings = config.settings if config.estimator == SMOOTHER else {}
    smoothing = replace(config, estimator=SMOOTHER, settings=settings)
    start = log.rig.model_copy(update={"sensors": used_sensors(log, config.sensors)})
    started = perf_counter()
    with temporary_folder(of_system("grids")) as folder:
        knowledge = learn_by_turns(
            [log],
            start,
            lambda learnt_log: running.run(replace(log, rig=learnt_log.rig), smoothing),
            folder / "learnt",
            lambda done, _all: report((1.0 + done) / runs),
        )
        rig = knowledge.rig
        again = running.run(replace(log, rig=rig), config)
    report(1.0)
    learnt = replace(
        given,
        config={**given.config, "learnt_rig": rig.model_dump(mode="json", exclude_none=True)},
        final=again.final,
        timings=replace(given.timings, final_seconds=perf_counter() - started),
        warnings=(*given.warnings, *knowledge.notes),
    )
    return learnt, knowledge

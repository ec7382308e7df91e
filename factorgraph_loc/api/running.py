"""``fgloc run`` and ``fgloc compare`` as functions."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from factorgraph_loc.api.given import LogLike, RigLike, Settings, WorldLike, every
from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.evaluation.plots import write_plots
from factorgraph_loc.experiments import compare as comparing
from factorgraph_loc.experiments import output
from factorgraph_loc.experiments import run as running
from factorgraph_loc.experiments.learning import run_and_learn
from factorgraph_loc.fitting.constants import FittedConstant
from factorgraph_loc.fusion.registry import for_final_only
from factorgraph_loc.io.readers import read_log
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.model.scoring import MAX_GAP, TICK_GAP, Alignment, RunConfig
from factorgraph_loc.text import listed


@dataclass(frozen=True)
class Run:
    """The outcome of a run: its ``result``, its ``scores`` as in ``metrics.json``, and the constants of the rig that were
    ``learnt`` from the log, if asked for."""

    result: RunResult
    scores: dict[str, Any]
    learnt: tuple[FittedConstant, ...] = ()

    def __repr__(self) -> str:
        done = {"log": self.result.log, "estimator": self.result.config["estimator"], "status": "ok"}
        return comparing.told([done | self.scores])


def run(
    log: LogLike,
    estimator: str,
    *,
    settings: Settings | None = None,
    sensors: Sequence[str] | None = None,
    prior: str | None = None,
    seed: int = 0,
    rig: RigLike | None = None,
    world: WorldLike | None = None,
    max_gap: float = MAX_GAP,
    tick_gap: float = TICK_GAP,
    learn: bool = False,
    align: Alignment = "none",
    final_only: bool = False,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Run:
    """Run one estimator on one log and score the result.

    For the arguments see :class:`~factorgraph_loc.model.scoring.RunConfig`. ``learn``: learn the rig from the log itself, for
    the final trajectory alone. ``final_only``: make no causal estimates. ``align``: also score after this alignment with the
    reference. ``out``: folder for the files that ``fgloc run`` writes.
    """
    if out is not None:
        output.check_free(Path(out), overwrite=overwrite)
    given = {estimator: settings or {}}
    chosen = (for_final_only(given) if final_only else given)[estimator]
    loaded = read_log(log, rig=rig, world=world)
    config = RunConfig(estimator, chosen, None if sensors is None else tuple(sensors), prior, seed, max_gap, tick_gap)
    learnt: tuple[FittedConstant, ...] = ()
    if learn:
        learning = run_and_learn(loaded, config, progress)
        result, learnt = learning.result, tuple(learning.turns.knowledge.constants)
    else:
        result = running.run(loaded, config, progress)
    if out is None:
        return Run(result, score(result, loaded, align), learnt)
    scores = output.save_run(result, loaded, Path(out), align=align, overwrite=overwrite)
    write_plots(result, loaded, Path(out))
    return Run(result, scores, learnt)


def compare(
    logs: LogLike | Sequence[LogLike],
    estimators: Sequence[str],
    out: str | Path,
    *,
    settings: Mapping[str, Settings] | None = None,
    sensors: Sequence[str] | None = None,
    prior: str | None = None,
    seeds: Iterable[int] = (0,),
    rig: RigLike | None = None,
    world: WorldLike | None = None,
    max_gap: float = MAX_GAP,
    tick_gap: float = TICK_GAP,
    align: Alignment = "none",
    rpe: bool = False,
    final_only: bool = False,
    jobs: int | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> comparing.Comparison:
    """Run several estimators on several logs with each seed, in ``jobs`` processes, and write tables and plots to ``out``.

    ``settings`` are given per estimator. ``align``, ``rpe``: what is scored and shown further. ``final_only``: make no causal
    estimates, where an estimator can do without. See
    :func:`factorgraph_loc.experiments.compare.compare`.
    """
    comparing.check_free(Path(out), overwrite=overwrite)
    if others := [name for name in settings or {} if name not in estimators]:
        raise InputError(f"settings are given for {others[0]}, which is not run here; run: {listed(estimators)}")
    named: Mapping[str, Settings] = {name: (settings or {}).get(name, {}) for name in estimators}
    if final_only:
        named = for_final_only(named)
    return comparing.compare(
        every(logs, rig, world),
        named,
        Path(out),
        sensors=(None if sensors is None else tuple(sensors),),
        prior=prior,
        seeds=tuple(seeds),
        max_gap=max_gap,
        tick_gap=tick_gap,
        align=align,
        rpe=rpe,
        jobs=jobs,
        overwrite=overwrite,
        progress=progress,
    )

"""``fgloc run`` as a function."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.evaluation.plots import write_plots
from factorgraph_loc.experiments import output
from factorgraph_loc.experiments import run as running
from factorgraph_loc.experiments.compare import summary_text
from factorgraph_loc.experiments.learning import run_and_learn
from factorgraph_loc.files.temporary import require_free
from factorgraph_loc.fitting.posterior import FittedConstant
from factorgraph_loc.fusion.registry import for_final_only
from factorgraph_loc.io.readers import LogLike, RigLike, WorldLike, read_log
from factorgraph_loc.io.results import FILES
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.model.scoring import MAX_GAP, TICK_GAP, Alignment, RunConfig


@dataclass(frozen=True)
class Run:
    """The outcome of a run: its ``result``, its ``scores`` as in ``metrics.json``, and the constants of the rig that were
    ``learnt`` from the log, if asked for."""

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
        require_free(Path(out), FILES, overwrite=overwrite)
    given = {estimator: settings or {}}
    chosen = (for_final_only(given) if final_only else given)[estimator]
    loaded = read_log(log, rig=rig, world=world)
    config = RunConfig(estimator, chosen, None if sensors is None else tuple(sensors), prior, seed, max_gap, tick_gap)
    learnt: tuple[FittedConstant, ...] = ()
    if learn:
        learning = run_and_learn(loaded, config, progress)
        result, learnt = learning.result, tuple(learning.knowledge.constants)
    else:
        result = running.run(loaded, config, progress)
    if out is None:
        return Run(result, score(result, loaded, align), learnt)
    scores = output.save_run(result, loaded, Path(out), align=align, overwrite=overwrite)
    write_plots(result, loaded, Path(out))
    return Run(result, scores, learnt)

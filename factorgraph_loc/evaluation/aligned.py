"""Scores of a run, also after an alignment with the reference where one is asked for."""

from typing import Any

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation import metrics
from factorgraph_loc.evaluation.trajectories.score import score_paths
from factorgraph_loc.evaluation.warned import WARNINGS
from factorgraph_loc.model.log import Log
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.model.scoring import Alignment
from factorgraph_loc.model.trajectory import Trajectory
from factorgraph_loc.model.trajectory3 import path_of

FIGURES = ("aligned_position_rmse", "aligned_rotation_rmse")


def score(result: RunResult, log: Log, align: Alignment = "none") -> dict[str, Any]:
    """The figures of :func:`factorgraph_loc.evaluation.metrics.score`, and with ``align`` those after that alignment.

    These are ``scoring.align``, and ``causal.*`` and ``final.*`` of :data:`FIGURES` [m, rad], at the same stamps, as
    :func:`~factorgraph_loc.evaluation.trajectories.score.score_paths` has them. They are None without a reference, and where the
    poses do not determine the alignment; ``warnings`` says why.
    """
    scores = metrics.score(result, log)
    if align == "none":
        return scores
    scores["scoring.align"] = align
    causal, final = result.causal(), result.final
    if causal is not None:
        final = metrics.since(final, float(causal.t[0]))
    for kind, trajectory in (("causal", causal), ("final", final)):
        figures: dict[str, float | None] = dict.fromkeys(FIGURES)
        try:
            figures |= _aligned(trajectory, log, align, result.max_gap)
        except InputError as error:
            scores[WARNINGS] = list(dict.fromkeys((*scores[WARNINGS], f"not aligned: {error}")))
        scores |= {f"{kind}.{name}": value for name, value in figures.items()}
    return scores


def _aligned(trajectory: Trajectory | None, log: Log, align: Alignment, max_gap: float) -> dict[str, float | None]:
    if trajectory is None or log.reference is None or not len(trajectory):
        return {}
    paths = path_of(trajectory, log.name), path_of(log.reference, "the reference")
    found = score_paths(*paths, align, "interpolate", max_gap=max_gap).figures
    return {name: found[f"ape.{name.removeprefix('aligned_')}"] for name in FIGURES}

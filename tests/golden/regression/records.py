"""What is held of a run: numbers at some stamps, figures of accuracy, and what is compared exactly."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_loc import InputError, Log, RunFailedError, Trajectory
from factorgraph_loc.evaluation.metrics import score
from factorgraph_loc.experiments.run import RunConfig, run
from factorgraph_loc.files.models import write_text
from factorgraph_loc.fusion.base import Estimator
from factorgraph_loc.model.belief import Belief, Learnt
from factorgraph_loc.model.diagnostics import Diagnostics
from factorgraph_loc.model.measurement import columns_of
from factorgraph_loc.model.result import RunResult
from factorgraph_loc.planning.closed_loop import ActiveRun
from factors.se2 import Array

CAUSAL, FINAL, SUMS, LEARNT = 10, 6, 4, 12  # rows that are held, at most
BELIEFS = 50  # ticks from one belief that is looked at to the next
DIGITS = 7  # of numbers in files that are compared to 1e-6
RMSE = ("causal.position_rmse", "final.position_rmse")


@dataclass(frozen=True)
class Record:
    """``exact``: plain values by name; ``numbers``: arrays by name, whose last word says what they are (see
    :mod:`regression.differences`); ``rmse`` [m] of the whole run, where there is a reference."""

    exact: Mapping[str, Any]
    numbers: Mapping[str, Array] = field(default_factory=dict)
    rmse: Mapping[str, float] = field(default_factory=dict)


def record_run(log: Log, config: RunConfig) -> Record:
    """Run an estimator on a log; a run that is refused or fails is held by its message."""
    beliefs: list[Belief] = []

    def watch(t: float, estimator: Estimator) -> None:
        nonlocal ticks
        if ticks % BELIEFS == BELIEFS - 1:
            beliefs.append(estimator.belief(t))
        ticks += 1

    ticks = 0
    try:
        result = run(log, config, watch=watch)
    except (InputError, RunFailedError) as error:
        return Record({type(error).__name__: str(error)})
    figures = score(result, log)
    exact, numbers = _of_result(result)
    for more_exact, more_numbers in (
        _of_beliefs(beliefs),
        _of_diagnostics(result.diagnostics),
        _of_learnt(result.learnt),
    ):
        exact, numbers = exact | more_exact, numbers | more_numbers
    return Record(
        {name: value for name, value in exact.items() if value not in ({}, [], None)},
        {name: values for name, values in numbers.items() if values.size},
        {name: figures[name] for name in RMSE if figures.get(name) is not None},
    )


def record_active(found: ActiveRun) -> Record:
    """An active run: where it went, what it believed at each choice, and what it chose among."""
    ways = [step.chosen if step.chosen is not None else np.full((1, 3), np.nan) for step in found.steps]
    exact = {
        "localized": found.localized,
        "claimed_wrong": found.claimed_wrong,
        "candidates": [len(step.candidates) for step in found.steps],
    }
    chosen = np.array([way[-1] for way in ways]).reshape(-1, 3)
    values = [[np.nanmax(step.values), np.nanmean(step.values)] for step in found.steps if len(step.values)]
    numbers = {
        "truth.poses": found.truth.poses[_some(len(found.truth), CAUSAL)],
        "steps.t": np.array([step.t for step in found.steps]),
        "steps.poses": np.array([step.pose for step in found.steps]).reshape(-1, 3),
        "steps.covariances": _upper(np.array([step.covariance for step in found.steps]).reshape(-1, 3, 3)),
        "steps.particles.sums": np.array([np.sum(step.particles) for step in found.steps]),
        "steps.chosen.poses": chosen,
        "steps.values": np.array(values).reshape(-1, 2),
    }
    return Record(exact, numbers, {"error": found.error_position})


def record_log(log: Log) -> Record:
    """A log itself, as sums over the columns of its streams: whether a result changed because the log did."""
    exact: dict[str, Any] = {"sensors": list(log.rig.sensors)}
    numbers: dict[str, Array] = {}
    for name, stream in log.streams.items():
        exact[f"{name}.rows"] = len(stream.t)
        for column, values in columns_of(stream).items():
            if isinstance(values, np.ndarray):
                known = values[np.isfinite(values)]
                numbers[f"{name}.{column}.sums"] = np.array([len(known), known.sum(), np.square(known).sum()])
            elif all(isinstance(value, str) for value in values):
                exact[f"{name}.{column}.names"] = len(set(values))
    if log.reference is not None:
        numbers["reference.poses"] = log.reference.poses[_some(len(log.reference), 4)]
    return Record(exact, numbers)


def write_records(path: Path, records: Mapping[str, Record], digits: int | None = None) -> None:
    """Write the records of a scenario by the label of the estimator: JSON with a line for each quantity, its numbers with so many
    digits, or all of them; NaN is null."""
    cases = []
    for label, record in records.items():
        lines = [f'"exact": {json.dumps(record.exact, ensure_ascii=False)}']
        lines += [f'"{name}": {_dumped(values, digits)}' for name, values in record.numbers.items()]
        lines.append(f'"rmse": {json.dumps({name: float(f"{x:.4g}") for name, x in record.rmse.items()})}')
        cases.append(f'"{label}": {{\n ' + ",\n ".join(lines) + "\n}")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, "{\n" + ",\n".join(cases) + "\n}\n")


def read_records(path: Path) -> dict[str, Record]:
    """The records of a scenario by the label of the estimator."""
    found = json.loads(path.read_text())
    return {
        label: Record(
            content.pop("exact"),
            rmse=content.pop("rmse"),
            numbers={k: np.array(v, dtype=float) for k, v in content.items()},
        )
        for label, content in found.items()
    }


def _dumped(values: Array, digits: int | None) -> str:
    def plain(value: Any) -> Any:
        if isinstance(value, list):
            return [plain(v) for v in value]
        if not np.isfinite(value):
            return None
        shortened = value if digits is None else float(f"{value:.{digits}g}")
        return int(shortened) if shortened.is_integer() and abs(shortened) < 1e6 else shortened

    return json.dumps(plain(np.asarray(values, dtype=float).tolist()), separators=(",", ":"))


def _some(count: int, most: int) -> Array:
    """Indices of at most so many rows, evenly from the first to the last."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(most, count)).round().astype(int))


def _upper(covariances: Array) -> Array:
    """The upper triangles (N, D (D + 1) / 2) of (N, D, D)."""
    return covariances[(slice(None), *np.triu_indices(covariances.shape[-1]))]


def _of_result(result: RunResult) -> tuple[dict[str, Any], dict[str, Array]]:
    changes = [i for i, s in enumerate(result.status) if i == 0 or s != result.status[i - 1]]
    exact: dict[str, Any] = {
        "ticks": len(result.t),
        "status": [[i, result.status[i]] for i in changes],
        "final": len(result.final),
        "warnings": [
            re.sub(r"(?<!\S)/\S*/", "", str(warning)) for warning in result.warnings
        ],  # wherever the data lies
    }
    numbers = _of_trajectory("causal", Trajectory(result.t, result.poses, result.covariances), CAUSAL)
    numbers |= _of_trajectory("final", result.final, FINAL)
    return exact, numbers


def _of_trajectory(kind: str, trajectory: Trajectory, most: int) -> dict[str, Array]:
    rows = _some(len(trajectory), most)
    found = {f"{kind}.t": trajectory.t[[0, -1]] if len(rows) else trajectory.t, f"{kind}.poses": trajectory.poses[rows]}
    if trajectory.covariances is not None:
        found[f"{kind}.covariances"] = _upper(trajectory.covariances[rows])
    return found


def _of_beliefs(beliefs: Sequence[Belief]) -> tuple[dict[str, Any], dict[str, Array]]:
    """How many modes and particles, and the heaviest mode."""
    heaviest = [max(belief.modes, key=lambda mode: mode.weight) for belief in beliefs if belief.modes]
    counts = [[len(belief.modes), 0 if belief.particles is None else len(belief.particles)] for belief in beliefs]
    numbers = {
        "belief.weights": np.array([mode.weight for mode in heaviest]),
        "belief.poses": np.array([mode.pose for mode in heaviest]).reshape(-1, 3),
    }
    return {"belief": counts}, numbers


def _of_diagnostics(diagnostics: Diagnostics) -> tuple[dict[str, Any], dict[str, Array]]:
    exact: dict[str, Any] = {
        "nis": {
            sensor: [len(rows), sum(dof for _, _, dof in rows)] for sensor, rows in sorted(diagnostics.nis.items())
        },
        "residuals": {name: len(values) for name, values in sorted(diagnostics.residuals.items())},
        **{name: dict(sorted(getattr(diagnostics, name).items())) for name in ("ignored", "rejected", "late")},
        "events": [str(event) for event in diagnostics.events],
        "dead_tags": sorted(dead := diagnostics.doubted.get("dead_tags", {})),
    }
    numbers = {
        "events.t": np.array([event.t for event in diagnostics.events]),
        "dead_tags.probabilities": np.array([p for _, p in sorted(dead.items())]),
    }
    if moved := diagnostics.doubted.get("moved_tags"):
        exact["moved_tags"] = sorted(moved)
        numbers["moved_tags.probabilities"] = np.array([p for _, p in sorted(moved.items())])
    for sensor, rows in sorted(diagnostics.nis.items()):
        table = np.array([(t, nis) for t, nis, _ in rows])
        which = _some(len(table), SUMS)
        numbers[f"nis.{sensor}.t"] = table[which, 0]
        numbers[f"nis.{sensor}.sums"] = np.cumsum(table[:, 1])[which]
    for name, values in sorted(diagnostics.residuals.items()):
        known = np.array(values)[np.isfinite(values)]
        numbers[f"residuals.{name}.sums"] = np.array([known.sum(), np.square(known).sum()])
    return exact, numbers


def _of_learnt(learnt: Learnt) -> tuple[dict[str, Any], dict[str, Array]]:
    constants, landmarks, points = sorted(learnt.values.items()), sorted(learnt.landmarks.items()), learnt.points
    exact: dict[str, Any] = {
        "learnt": [name for name, _ in constants],
        "landmarks": [name for name, _ in landmarks],
        "points": None if points is None else [len(points), list(points.names[:LEARNT])],
    }
    numbers = {"learnt.constants": np.array([pair for _, pair in constants]).reshape(-1, 2)}
    some = [landmark for _, landmark in landmarks[:LEARNT]]
    if some:
        numbers["landmarks.positions"] = np.array([landmark.position for landmark in some])
        numbers["landmarks.covariances"] = _upper(np.array([landmark.covariance for landmark in some]))
    if points is not None:
        numbers["points.positions"] = points.positions[:LEARNT]
        numbers["points.covariances"] = _upper(points.covariances[:LEARNT])
    return exact, numbers

"""Data read from the files of the runs for the page: trajectories, errors, consistency, configurations."""

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from factorgraph_loc.drawing.markup import Html, data
from factorgraph_loc.evaluation.inference import mean_nees_band
from factorgraph_loc.evaluation.report import tracks
from factorgraph_loc.evaluation.report.results import Results, Row, score
from factorgraph_loc.evaluation.report.scene import Scene
from factorgraph_loc.evaluation.report.tracks import KINDS, Series
from factors.se2 import Array

POSES = 200_000  # on the page, shared by all trajectories
FEWEST, MOST = 60, 1200  # bounds for one trajectory
TRACKS = 1000  # maximum number of runs with trajectories; further logs appear in tables only
_ESTIMATES, _CONFIG = "estimates.parquet", "config.toml"


@dataclass(frozen=True)
class RunFiles:
    """``read``: returns the content of a file of a run (``estimates.parquet``, ``config.toml``) by its name; ``scene``: map of
    the log, if known."""

    read: Callable[[str], bytes]
    scene: Scene | None = None


@dataclass
class RunData:
    """The data read from all runs.

    ``tracks``: packed trajectories of each log in ``logs``, as elements of the page. ``errors``: by kind, log and variant,
    quantiles of the position error [m]. ``nees``: by variant and log, mean NEES of the causal poses per degree of freedom;
    ``trust``: by variant, the mean over logs and its 95 % band for correct covariances. ``configs``: ``text`` of the
    configuration of a ``run``; ``versions``: of the software used by the first run.
    """

    tracks: list[Html] = field(default_factory=list)
    logs: list[str] = field(default_factory=list)
    errors: dict[str, list[list[list[float]]]] = field(default_factory=lambda: {kind: [] for kind in KINDS})
    nees: dict[tuple[str, str], float] = field(default_factory=dict)
    trust: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    configs: list[dict[str, str]] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)


def read_runs(results: Results, metric: str, runs: Callable[[str], RunFiles]) -> RunData:
    """Read the files of all successful runs; of several seeds the trajectory with the median ``metric`` is drawn."""
    found = RunData()
    chosen = {
        (variant, log): row
        for log in results.logs
        for variant in results.variants
        if (row := results.representative(variant, log, metric)) is not None
    }
    poses = min(MOST, max(FEWEST, POSES // (len(KINDS) * max(1, min(len(chosen), TRACKS)))))
    counts: dict[str, list[tuple[float, float, int]]] = {}
    left = TRACKS
    for log in results.logs:
        drawn: list[dict[str, Any]] = []
        scene: Scene | None = None
        of_log: dict[str, list[list[float]]] = {kind: [] for kind in KINDS}
        for place, variant in enumerate(results.variants):
            row = chosen.get((variant, log))
            if row is None:
                for quantiles in of_log.values():
                    quantiles.append([])
                continue
            files = runs(str(row["key"]))
            scene = scene or files.scene
            series = tracks.read_series(files.read(_ESTIMATES), files.scene.t0_ns if files.scene else None)
            if left > 0:
                packed = {kind: tracks.pack(s, poses) for kind, s in series.items()}
                drawn.append({"v": place, "seed": row["seed"], **packed})
                _add_config(found, f"{variant}, {log}, seed {row['seed']}", files.read(_CONFIG).decode())
            if (trust := _consistency(row, series)) is not None:
                counts.setdefault(variant, []).append(trust)
                found.nees[variant, log] = trust[0]
            others = [other for other in results.runs(variant, log) if other is not row and other["status"] == "ok"]
            every = [(row, _errors(series)), *((other, _read_errors(runs, other)) for other in others)]
            for kind, quantiles in of_log.items():
                scored = [e[kind] for one, e in every if kind in e and score(one, f"{kind}.position_rmse") is not None]
                quantiles.append(tracks.quantiles(scored))
        for kind, quantiles in of_log.items():
            found.errors[kind].append(quantiles)
        if drawn:
            content = {"scene": scene.content() if scene else None, "runs": drawn}
            found.tracks.append(data(f"track-{len(found.logs)}", content))
            found.logs.append(log)
            left -= len(drawn)
    for variant, values in counts.items():
        means, independent, dofs = zip(*values, strict=True)
        band = mean_nees_band(independent, sum(dofs) / len(dofs))
        found.trust[variant] = (sum(means) / len(means), *band)
    return found


def _read_errors(runs: Callable[[str], RunFiles], row: Row) -> dict[str, Array]:
    return tracks.read_errors(runs(str(row["key"])).read(_ESTIMATES))


def _errors(series: Mapping[str, Series]) -> dict[str, Array]:
    return {kind: of.known_errors() for kind, of in series.items()}


def _consistency(row: Row, series: Mapping[str, Series]) -> tuple[float, float, int] | None:
    if "causal" not in series or score(row, "causal.position_rmse") is None:
        return None
    return tracks.consistency(series["causal"])


def _add_config(found: RunData, run: str, text: str) -> None:
    found.configs.append({"run": run, "text": text})
    if not found.versions:
        content = tomllib.loads(text)
        found.versions = {str(name): str(version) for name, version in content.get("versions", {}).items()}

"""Runs of all estimators on short logs with faults of sensors, clocks, maps or rigs."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.random import Generator

import factorgraph_loc as fgloc
from fuzzing import damage
from fuzzing.absurd import pick
from fuzzing.calls import ESTIMATORS
from fuzzing.results import check_pose
from fuzzing.verdicts import WrongResultError

Table = list[list[str]]
Files = dict[str, bytes]
TABLES = ("odometry.csv", "bearing_range.csv", "rfid.csv", "sightings.csv", "imu.csv", "inventories.csv")
SENSORS = (
    None,
    ("odometry",),
    ("odometry", "bearing_range"),
    ("odometry", "rfid"),
    ("odometry", "imu", "bearing_range"),
    ("odometry", "rfid", "rssi", "phase"),
    ("odometry", "sightings"),
    ("odometry", "imu", "rfid", "bearing_range", "sightings"),
)
PRIORS = (None, None, None, "reference", "log", "unknown", "0,0,0", "10,6", "1e5,-1e5,3", "13.9,7.75")


def run_with_faults(files: Mapping[str, bytes], folder: Path, rng: Generator) -> None:
    """Put faults into a log, run an estimator on it, and check the results."""
    content = dict(files)
    for _ in range(int(pick(rng, (1, 1, 2, 2, 3)))):
        pick(rng, FAULTS)(content, rng)
    damage.write(folder, content)
    log = fgloc.read_log(folder)
    estimator = pick(rng, tuple(ESTIMATORS))
    settings, sensors, prior = pick(rng, ESTIMATORS[estimator]), pick(rng, SENSORS), pick(rng, PRIORS)
    (folder / "run.txt").write_text(f"{estimator} {settings} {sensors} {prior}\n")
    check(fgloc.run(log, estimator, settings=settings, sensors=sensors, prior=prior, seed=int(rng.integers(10))))


def check(run: fgloc.Run) -> None:
    result = run.result
    for t, pose, covariance, status in zip(result.t, result.poses, result.covariances, result.status, strict=True):
        if status != "unlocalized" or np.isfinite(pose).all():
            check_pose(f"the estimate at {t:.1f} s", pose, covariance)
    final = result.final
    for i in range(len(final.t)):
        check_pose(
            f"the final pose at {final.t[i]:.1f} s",
            final.poses[i],
            np.eye(3) if final.covariances is None else final.covariances[i],
        )
    _check_numbers(run.scores, "scores")


def _check_numbers(tree: Any, where: str) -> None:
    """Check that metrics.json contains numbers or null."""
    if isinstance(tree, Mapping):
        for key, value in tree.items():
            _check_numbers(value, f"{where}.{key}")
    elif isinstance(tree, (list, tuple)):
        for value in tree:
            _check_numbers(value, where)
    elif isinstance(tree, float) and not math.isfinite(tree):
        raise WrongResultError(f"{where} is {tree}")


def _on_table(change: Callable[[Table, Generator], None]) -> Callable[[Files, Generator], None]:
    """A fault in the rows of one of the sensors' tables, most often the odometry's."""

    def on(files: Files, rng: Generator) -> None:
        name = pick(
            rng, [name for name in ("odometry.csv", *TABLES, "bearing_range.csv") if name in files] or ["run.toml"]
        )
        head, *rows = [line.split(",") for line in files[name].decode().splitlines()]
        if rows:
            change(rows, rng)
        files[name] = ("\n".join(",".join(row) for row in [head, *rows]) + "\n").encode()

    return on


def _cell(row: list[str], j: int, change: Callable[[float], float]) -> None:
    try:
        row[j] = repr(change(float(row[j])))
    except ValueError:  # a name, or empty
        return


def _column(rows: Table, rng: Generator) -> int:
    return int(rng.integers(1, max(2, len(rows[0]))))


def glitch(rows: Table, rng: Generator) -> None:
    """One or several values of another magnitude."""
    j, factor = _column(rows, rng), 10.0 ** int(rng.integers(-12, 9))
    for i in rng.integers(len(rows), size=int(pick(rng, (1, 1, 1, 3, 10)))).tolist():
        _cell(rows[i], j, lambda v: pick(rng, (v * factor, factor, -factor, v + factor, 0.0)))


def scaled(rows: Table, rng: Generator) -> None:
    """A column in another unit, or with another sign."""
    j, factor = _column(rows, rng), float(pick(rng, (-1.0, 0.0, 1e-9, 1e-3, 10.0, 57.3, 1000.0, 1e-300)))
    for row in rows:
        _cell(row, j, lambda v: v * factor)


def stuck(rows: Table, rng: Generator) -> None:
    j, value = _column(rows, rng), pick(rng, rows)
    for row in rows[int(rng.integers(len(rows))) :]:
        row[j : j + 1] = value[j : j + 1]


def repeated(rows: Table, rng: Generator) -> None:
    i = int(rng.integers(len(rows)))
    rows[i:i] = [list(row) for row in rows[i : i + int(pick(rng, (1, 5, 1000)))]]


def missing(rows: Table, rng: Generator) -> None:
    i = int(rng.integers(len(rows)))
    del rows[i : i + int(pick(rng, (1, 5, 20, 1000)))]


def few(rows: Table, rng: Generator) -> None:
    del rows[int(pick(rng, (1, 2, 3))) :]


def jumping(rows: Table, rng: Generator) -> None:
    """The clock jumps, or runs at another rate."""
    i, jump = (
        int(rng.integers(len(rows))),
        int(pick(rng, (1, 10**6, 10**8, 10**9, 7 * 10**10, 10**13, 17 * 10**17, -(10**8), -(10**9)))),
    )
    rate = float(pick(rng, (1.0, 1.0, 1.0, 0.001, 0.5, 3.0, 100.0)))
    for row in rows[i:]:
        row[0] = str(int(int(row[0]) * rate) + jump)


def same_time(rows: Table, rng: Generator) -> None:
    i = int(rng.integers(len(rows)))
    for row in rows[i : i + int(pick(rng, (2, 5, 1000)))]:
        row[0] = rows[i][0]


def swapped(rows: Table, rng: Generator) -> None:
    i, j = (int(k) for k in rng.integers(len(rows), size=2))
    rows[i], rows[j] = rows[j], rows[i]


def _leaves(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[tuple[Any, ...], float]]:
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    out = []
    for key, value in items:
        if isinstance(value, float):
            out.append(((*path, key), value))
        else:
            out += _leaves(value, (*path, key))
    return out


def _set(tree: Any, path: tuple[Any, ...], value: float) -> None:
    for key in path[:-1]:
        tree = tree[key]
    tree[path[-1]] = value


def of_rig(files: Files, rng: Generator) -> None:
    """Tiny or huge noise, other mountings, uncertain constants."""
    tree = tomllib.loads(files["sim.rig.toml"].decode())
    leaves = _leaves(tree)
    for _ in range(int(pick(rng, (1, 2, 4)))):
        path, value = pick(rng, leaves)
        new = value * 10.0 ** int(rng.integers(-9, 7)) if value else 10.0 ** int(rng.integers(-9, 2))
        _set(tree, path, pick(rng, (new, new, 0.0, -value, value + 0.5)))
    files["sim.rig.toml"] = tomli_w.dumps(tree).encode()


def of_map(files: Files, rng: Generator) -> None:
    """Landmarks at one position, at the robot's, far away or with other names; no map at all."""
    tree, choice = tomllib.loads(files["sim.world.toml"].decode()), rng.integers(6)
    marks = tree.get("landmarks", {})
    start = tomllib.loads(files["run.toml"].decode()).get("start", {"x": 0.0, "y": 0.0})
    far = 10.0 ** int(rng.integers(0, 7))
    for name in list(marks):
        if choice == 0:
            marks[name] |= {"x": 5.0, "y": 5.0}
        elif choice == 1:
            marks[name] |= {"x": start["x"], "y": start["y"]}
        elif choice == 2:
            marks[name]["x"] = marks[name]["x"] + far
        elif choice == 3:
            marks[name]["sigma"] = float(pick(rng, (1e-12, 1e-6, 0.0, 10.0, 100.0)))
        elif choice == 4 and rng.random() < 0.7:
            del marks[name]
    if choice == 5:
        tree.pop(str(pick(rng, ("landmarks", "tags", "points", "walls"))), None)
    files["sim.world.toml"] = tomli_w.dumps(tree).encode()


def of_tags(files: Files, rng: Generator) -> None:
    """Tags at one position or far away."""
    head, *rows = [line.split(",") for line in files["sim.tags.csv"].decode().splitlines()]
    factor, same = float(pick(rng, (0.0, 1e-3, 10.0, 1e4))), rng.random() < 0.5
    for row in rows:
        row[1:4] = rows[0][1:4] if same else [repr(float(v) * factor) for v in row[1:4]]
    files["sim.tags.csv"] = ("\n".join(",".join(row) for row in [head, *rows]) + "\n").encode()


def of_files(files: Files, rng: Generator) -> None:
    """A missing sensor or reference."""
    files.pop(pick(rng, (*TABLES[1:], "reference.tum")), None)


FAULTS = (
    *(
        _on_table(fault)
        for fault in (glitch, glitch, glitch, scaled, stuck, repeated, missing, few, jumping, same_time, swapped)
    ),
    *(of_rig, of_rig, of_map, of_map, of_tags, of_files),
)

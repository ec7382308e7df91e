"""Our estimators beside loops around other packages, on one recorded log, with the same noise and scorer.

What counts is the processor time of the loop alone. Each program has a process of its own; they take turns, and the least of
the times of each counts.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from factorgraph_loc.errors import InputError
from factorgraph_loc.io.readers import describe, load
from speed_benchmark.ours import CONFIGS, LOG
from speed_benchmark.problems import problem_of

BENCHMARKS = Path(__file__).parents[1]
_IMPORT = """
import importlib, json, sys
lacking = {}
for package in sys.argv[1:]:
    try:
        importlib.import_module(package)
    except Exception as error:
        lacking[package] = str(error)
print(json.dumps(lacking))
"""
LONGEST = 1800.0  # s that a program may take


@dataclass(frozen=True)
class Peer:
    """What is compared with our estimator ``ours``: a loop of a program, and the package that it needs, None for GTSAM."""

    ours: str
    what: str
    program: str
    loop: str
    package: str | None = None


PEERS = (
    Peer("EKF", "filterpy, motion composed to each stamp", "filterpy_ekf", "composed", "filterpy"),
    Peer("EKF", "filterpy, each row of odometry", "filterpy_ekf", "rows", "filterpy"),
    Peer("EKF, 5 constants", "filterpy without constants", "filterpy_ekf", "composed", "filterpy"),
    Peer("smoother, lag 10 s, 5 constants", "fixed-lag smoother in a plain loop", "gtsam_loops", "lag"),
    Peer("smoother, 5 constants", "iSAM2 in a plain loop", "gtsam_loops", "full"),
    Peer("smoother, full history, 5 constants", "iSAM2 in a plain loop", "gtsam_loops", "full"),
    Peer("batch", "GTSAM's factors, from dead reckoning", "gtsam_loops", "batch"),
)


def missing(python: str, packages: Sequence[str]) -> dict[str, str]:
    """Those of ``packages`` that an interpreter cannot import, and why. Raises InputError if there is no such interpreter."""
    try:
        done = subprocess.run([python, "-c", _IMPORT, *packages], capture_output=True, text=True, check=True)
        found: dict[str, str] = json.loads(done.stdout.splitlines()[-1])
    except (OSError, subprocess.CalledProcessError, ValueError, IndexError) as error:
        raise InputError(f"--peers: {python} is no Python that can be called") from error
    return found


def measure(commands: Sequence[Sequence[str]], rounds: int) -> list[dict[str, float]]:
    """What each command says in the round that took it the least time. Raises InputError if one fails."""
    best: list[dict[str, float]] = [{} for _ in commands]
    for _ in range(rounds):
        for i, command in enumerate(commands):
            environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
            path = [str(BENCHMARKS), str(BENCHMARKS.parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
            environment["PYTHONPATH"] = os.pathsep.join(path)
            done = subprocess.run(
                command, capture_output=True, text=True, check=False, env=environment, timeout=LONGEST
            )
            if done.returncode:
                last = (done.stderr.strip().splitlines() or ["no word"])[-1]
                raise InputError(f"{' '.join(command[2:])}: {last}")
            found = json.loads(done.stdout.splitlines()[-1])
            if not best[i] or found["seconds"] < best[i]["seconds"]:
                best[i] = found
    return best


def table(peers: Sequence[Peer], ours: dict[str, dict[str, float]], others: Sequence[dict[str, float]]) -> list[str]:
    """The lines of the table."""
    lines = [
        "| ours | s | an update [ms] | error [m] | elsewhere | s | an update [ms] | error [m] | elsewhere / ours |"
    ]
    lines += ["|---|---|---|---|---|---|---|---|---|"]
    last = ""
    for peer, other in zip(peers, others, strict=True):
        mine = _cells(ours[peer.ours]) if peer.ours != last else " | | "
        ratio = other["seconds"] / ours[peer.ours]["seconds"]
        name, last = peer.ours if peer.ours != last else "", peer.ours
        lines.append(f"| {name} | {mine} | {peer.what} | {_cells(other)} | {ratio:.2f} |")
    return lines


def _cells(found: dict[str, float]) -> str:
    update = f"{1e-3 * found['median']:.2f} / {1e-3 * found['p99']:.2f}" if "median" in found else "–"
    return f"{found['seconds']:.2f} | {update} | {found['position']:.3f}"


def compare_peers(python: str, data_root: Path | None, rounds: int) -> None:
    """Print the table. Raises InputError if the log is not there, or a program fails."""
    if LOG not in {d.name for d in describe(data_root) if d.present}:
        raise InputError(f"{LOG} is not in the folder of recorded data, see fgloc datasets")
    lacking = missing(python, sorted({peer.package for peer in PEERS if peer.package}))
    if lacking:
        print(f"left out: {'; '.join(f'{package} ({why})' for package, why in lacking.items())}")
    peers = [peer for peer in PEERS if peer.package not in lacking]
    labels = [label for label in CONFIGS if any(peer.ours == label for peer in peers)]
    if data_root is not None:
        os.environ["FGLOC_DATA"] = str(data_root)
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "problem.npz")
        problem_of(load(LOG, data_root=data_root)[0]).save(Path(path))
        own = [(sys.executable, "-m", "speed_benchmark.ours", path, label) for label in labels]
        others = [
            (
                python if peer.package else sys.executable,
                "-m",
                f"speed_benchmark.programs.{peer.program}",
                path,
                peer.loop,
            )
            for peer in peers
        ]
        found = measure([*own, *others], rounds)
    print(f"Processor time on {LOG}, the least of {rounds}; an update: median / 99 %\n")
    print("\n".join(table(peers, dict(zip(labels, found[: len(own)], strict=True)), found[len(own) :])))

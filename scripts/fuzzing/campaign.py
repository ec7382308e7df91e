"""Many cases of many kinds, and the table of outcomes."""

from __future__ import annotations

import itertools
import shutil
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fuzzing.cases import ESTIMATORS, LOCALIZER, Case
from fuzzing.uses import FORMATS
from fuzzing.verdicts import Verdict
from fuzzing.workers import Worker

SHARES = {LOCALIZER: 20_000, ESTIMATORS: 5_000}  # relative to 100,000 damaged inputs of all formats
INPUTS = 100_000
BATCHES = {LOCALIZER: 20, ESTIMATORS: 5}
BATCH = 100  # cases of a format that a process tries before another format


@dataclass(frozen=True)
class Batch:
    kind: str
    first: int
    count: int


@dataclass
class Outcomes:
    """Number of cases by kind and outcome, the bad ones, and the total time in all processes [s]."""

    counts: dict[str, Counter[str]] = field(default_factory=dict)
    bad: list[tuple[Case, Verdict, Path]] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    def table(self) -> list[str]:
        head = f"{'kind':14s}{'cases':>9s}{'read':>9s}{'refused':>9s}{'BAD':>7s}{'cases/s':>9s}"
        rows = [self._row(kind, self.counts[kind], self.seconds[kind]) for kind in self.counts]
        total = sum(self.counts.values(), Counter[str]())
        return [head, *rows, self._row("all", total, sum(self.seconds.values()))]

    @staticmethod
    def _row(kind: str, found: Counter[str], seconds: float) -> str:
        rate = found.total() / max(seconds, 1e-9)
        return f"{kind:14s}{found.total():9d}{found['read']:9d}{found['refused']:9d}{found['bad']:7d}{rate:9.1f}"

    def faults(self) -> list[str]:
        """The bad cases by type and place, most frequent first, each with the command to repeat its first case."""
        alike: dict[tuple[str, str], list[tuple[Case, Verdict, Path]]] = {}
        for one in self.bad:
            alike.setdefault((one[1].error, one[1].place), []).append(one)
        lines = []
        for (error, place), group in sorted(alike.items(), key=lambda item: -len(item[1])):
            case, verdict, kept = group[0]
            kinds = ", ".join(sorted({one[0].kind for one in group}))
            lines.append(f"BAD x{len(group)} {error} at {place} ({kinds}): {' '.join(verdict.message.split())[:160]!r}")
            lines.append(f"    {case.command}    {kept}")
        return lines


def batches(kinds: Sequence[str], shares: dict[str, float], total: int | None) -> Iterator[Batch]:
    """Batches of all kinds in turn, in proportion to ``shares``; ``total``: number of cases, by default unlimited."""
    made = dict.fromkeys(kinds, 0)
    whole = sum(shares[kind] for kind in kinds)
    for _ in itertools.count():
        kind = min(kinds, key=lambda one: made[one] / shares[one])
        quota = None if total is None else round(total * shares[kind] / whole)
        count = BATCHES.get(kind, BATCH) if quota is None else min(BATCHES.get(kind, BATCH), quota - made[kind])
        if count <= 0:
            return
        yield Batch(kind, made[kind], count)
        made[kind] += count


def shares_of(kinds: Sequence[str]) -> dict[str, float]:
    """The proportion of each kind in a whole campaign."""
    weights = sum(one.weight for one in FORMATS.values())
    return {kind: SHARES[kind] if kind in SHARES else INPUTS * FORMATS[kind].weight / weights for kind in kinds}


class Campaign:
    """Tries batches with ``jobs`` processes below ``root``; bad cases are kept below ``keep``."""

    def __init__(self, root: Path, keep: Path, seed: int, jobs: int) -> None:
        self._root, self._keep, self._seed = root, keep, seed
        self._workers = [Worker(root, f"w{i}") for i in range(jobs)]
        self._lock = threading.Lock()
        self.outcomes = Outcomes()

    def run(self, work: Iterator[Batch], until: float) -> None:
        """Run until ``work`` is exhausted, or the clock (``time.monotonic()``) reaches ``until``."""
        threads = [
            threading.Thread(target=self._work, args=(worker, work, until), daemon=True) for worker in self._workers
        ]
        for thread in threads:
            thread.start()
        try:
            for thread in threads:
                thread.join()
        finally:
            for worker in self._workers:
                worker.close()

    def _work(self, worker: Worker, work: Iterator[Batch], until: float) -> None:
        while time.monotonic() < until:
            with self._lock:
                batch = next(work, None)
            if batch is None:
                return
            began = time.monotonic()
            for number, verdict in worker.try_cases(batch.kind, self._seed, batch.first, batch.count):
                self._note(worker, Case(batch.kind, self._seed, number), verdict)
            with self._lock:
                spent = self.outcomes.seconds
                spent[batch.kind] = spent.get(batch.kind, 0.0) + (time.monotonic() - began) / len(self._workers)

    def _note(self, worker: Worker, case: Case, verdict: Verdict) -> None:
        kept = self._keep / f"{case.kind}-{case.seed}-{case.number}"
        if verdict.outcome == "bad" and worker.case_folder.is_dir():
            shutil.rmtree(kept, ignore_errors=True)
            shutil.copytree(worker.case_folder, kept, symlinks=True, ignore=_no_pipes)
            (kept / "verdict.txt").write_text(
                f"{case.command}\n{verdict.error} at {verdict.place}\n{verdict.message}\n"
            )
        with self._lock:
            self.outcomes.counts.setdefault(case.kind, Counter())[verdict.outcome] += 1
            if verdict.outcome == "bad":
                self.outcomes.bad.append((case, verdict, kept))
                print(f"BAD {verdict.error} at {verdict.place}: {case.command}", file=sys.stderr, flush=True)


def _no_pipes(folder: str, names: list[str]) -> list[str]:
    """Named pipes, which cannot be copied."""
    return [name for name in names if (Path(folder) / name).is_fifo()]

"""A reproducible case, by its kind and number."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.random import Generator

from fuzzing import damage
from fuzzing.calls import play_random
from fuzzing.runs import run_with_faults
from fuzzing.uses import FORMATS, Inputs, quietly, warm_up
from fuzzing.verdicts import Verdict, judge

LOCALIZER, ESTIMATORS = "localizer", "estimators"
KINDS = (*FORMATS, LOCALIZER, ESTIMATORS)


@dataclass(frozen=True)
class Case:
    """The ``number``-th of its ``kind``, drawn from ``seed``."""

    kind: str
    seed: int
    number: int

    def generator(self) -> Generator:
        return np.random.default_rng((self.seed, zlib.crc32(self.kind.encode()), self.number))

    @property
    def command(self) -> str:
        return f"scripts/fuzz {self.kind} --seed {self.seed} --case {self.number}"


class Bench:
    """The place where cases are tried: seeds are stored below ``root``, the files of a case in ``folder``."""

    def __init__(self, root: Path, name: str = "case") -> None:
        self.folder = root / name
        self._inputs = Inputs(root, root / f"{name}-seed")
        self._ready: set[str] = set()
        (root / f"{name}-cache").mkdir(parents=True, exist_ok=True)
        os.environ["FGLOC_CACHE"] = str(root / f"{name}-cache")

    def prepare(self, kind: str) -> None:
        """Make the seed, and check that it can be read undamaged, which also compiles."""
        if kind in self._ready:
            return
        if not self._ready:
            damage.write(self.folder, self._inputs.files("images"))
            quietly(lambda: warm_up(self.folder))
        if kind in FORMATS:
            damage.write(self.folder, self._inputs.files(kind))
            quietly(lambda: FORMATS[kind].use(self.folder, np.random.default_rng(0)))
        elif kind == ESTIMATORS:
            self._inputs.files("native")
            for number in range(3):
                self.try_case(Case(kind, 0, number))
        else:
            for number in range(10):
                self.try_case(Case(kind, 0, number))
        self._ready.add(kind)

    def try_case(self, case: Case, *, tell: bool = False) -> Verdict:
        """The verdict on a case; its files stay in ``folder`` until the next one. ``tell``: print the traceback of bad cases."""
        rng = case.generator()
        return judge(lambda: quietly(self._call(case.kind, rng)), tell=tell)

    def _call(self, kind: str, rng: Generator) -> Callable[[], None]:
        if kind == LOCALIZER:
            return lambda: play_random(rng)
        if kind == ESTIMATORS:
            return lambda: run_with_faults(self._inputs.files("native"), self.folder, rng)
        one = FORMATS[kind]
        files = self._inputs.files(kind)
        some = {
            name: c
            for name, c in files.items()
            if not one.damaged or name.startswith(one.damaged) or name.endswith(one.damaged)
        }
        damage.write(self.folder, {**files, **damage.damaged(some, rng)})
        return lambda: one.use(self.folder, rng)

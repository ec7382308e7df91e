"""How far two records of one case are from each other."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from factors import se2
from factors.se2 import Array
from regression.records import Record


@dataclass(frozen=True)
class Difference:
    """Of one quantity: ``size`` in the units of :func:`size_of`, infinite where something is not comparable or must be the same
    and is not; then ``text`` tells what it was and is."""

    quantity: str
    size: float
    text: str = ""

    def __str__(self) -> str:
        return f"{self.quantity} {self.text or f'differs by {self.size:.1e}'}"


def differences(old: Record, new: Record) -> list[Difference]:
    """All that differs at all, the largest difference first."""
    found = []
    for name in sorted(old.exact.keys() | new.exact.keys()):
        was, now = old.exact.get(name), new.exact.get(name)
        if was != now:
            found.append(Difference(name, math.inf, f"was {was}, is {now}"))
    for name in sorted(old.numbers.keys() | new.numbers.keys()):
        if name not in old.numbers or name not in new.numbers:
            found.append(Difference(name, math.inf, "is new" if name in new.numbers else "is gone"))
        elif size := size_of(name, old.numbers[name], new.numbers[name]):
            found.append(Difference(name, size))
    return sorted(found, key=lambda d: -d.size)


def size_of(name: str, old: Array, new: Array) -> float:
    """The largest difference between two arrays of a quantity.

    Covariances (N, D (D + 1) / 2), upper triangles, are in units of the old standard deviations: 1e-6 is a millionth of a
    variance, or 1e-6 of a correlation. Constants (N, 2), value and standard deviation, are in units of the sum of both. All else
    is relative to 1 plus the old value; the last of three columns of poses is an angle. Infinite where shapes differ, or one is
    NaN and the other is not.
    """
    if old.size == new.size == 0:
        return 0.0
    if old.shape != new.shape or np.any(np.isnan(old) != np.isnan(new)):
        return math.inf
    difference = np.nan_to_num(new - old)
    kind = name.rpartition(".")[2]
    if kind == "covariances":
        units = _units(old)
    elif kind == "constants":
        units = np.abs(old[:, :1]) + old[:, 1:]
    else:
        units = 1.0 + np.abs(old)
        if kind == "poses":
            difference[:, 2] = se2.wrap(difference[:, 2])
    difference = np.abs(difference)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(difference > 0.0, difference / np.nan_to_num(units), 0.0)
    return float(shares.max())


def _units(upper: Array) -> Array:
    """Products of the standard deviations (N, D (D + 1) / 2) of upper triangles."""
    size = (math.isqrt(8 * upper.shape[1] + 1) - 1) // 2
    rows, columns = np.triu_indices(size)
    sigmas = np.sqrt(upper[:, rows == columns])
    return sigmas[:, rows] * sigmas[:, columns]

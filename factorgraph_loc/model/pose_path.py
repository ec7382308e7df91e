"""Poses with absolute times, as in files, bags and messages."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.planar import AS_IT_IS, Turned, on_floor
from factors.se2 import Array, Integers

_FLAT = 1e-9  # m and sines within which poses are planar


@dataclass(frozen=True)
class PosePath:
    """A sequence of poses: ``positions`` (N, 3) [m] and ``rotations`` (N, 3, 3) in a world frame.

    ``t_ns`` (N,): absolute times [ns], strictly increasing, or None if only the order of the poses is known. ``has_rotations`` is
    False if the rotations are meaningless. ``warnings``: one line for each problem that a reader corrected.
    """

    name: str
    positions: Array
    rotations: Array
    t_ns: Integers | None
    has_rotations: bool = True
    warnings: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def is_planar(self) -> bool:
        """Whether all poses have one height and stand upright."""
        return bool(np.ptp(self.positions[:, 2]) <= _FLAT and np.all(np.abs(self.rotations[:, 2, :2]) <= _FLAT))

    def seconds(self) -> Array:
        """The times (N,) in seconds since 1970, each the float nearest to it. ValueError if they are unknown."""
        if self.t_ns is None:
            raise ValueError(f"{self.name} has no times")
        return np.array([t / 10**9 for t in self.t_ns.tolist()])

    def rows(self, which: Integers) -> PosePath:
        """The poses with indices ``which``."""
        t_ns = None if self.t_ns is None else self.t_ns[which]
        return replace(self, positions=self.positions[which], rotations=self.rotations[which], t_ns=t_ns)

    def on_floor(self, warnings: list[str], turned: Turned = AS_IT_IS) -> Array:
        """Planar poses (N, 3): see :func:`~factorgraph_loc.model.planar.on_floor`."""
        return on_floor(self.name, self.positions, self.rotations if self.has_rotations else None, warnings, turned)

    def seen_from_above(self) -> PosePath:
        """The same poses at height 0, turned about the vertical axis only."""
        headings = np.arctan2(self.rotations[:, 1, 0], self.rotations[:, 0, 0])
        return replace(self, positions=self.positions * (1.0, 1.0, 0.0), rotations=upright(headings))


def require_poses(path: PosePath) -> None:
    """InputError if there are no poses, or one is not finite."""
    if not len(path):
        raise InputError(f"{path.name}: contains no poses, expected at least one")
    known = np.isfinite(path.positions).all(axis=1) & np.isfinite(path.rotations).all(axis=(1, 2))
    if not known.all():
        raise InputError(f"{path.name}: pose {int(np.argmin(known)) + 1} is not finite, expected finite numbers")


def upright(headings: Array) -> Array:
    """Rotations (N, 3, 3) by ``headings`` (N,) about the vertical axis."""
    out = np.zeros((len(headings), 3, 3))
    out[:, 0, 0] = out[:, 1, 1] = np.cos(headings)
    out[:, 1, 0] = np.sin(headings)
    out[:, 0, 1] = -np.sin(headings)
    out[:, 2, 2] = 1.0
    return out

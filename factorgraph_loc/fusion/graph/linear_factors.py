"""Our own factors in a solver of GTSAM's, which gets them as linear ones.

A callback from GTSAM copies all variables, and returns to Python for each factor. So a factor is linearised here, where iSAM2
linearises its variables, and replaced in the update that moves these: were it left behind, the factors would no longer agree on
what a turn of the whole graph does to the poses, and would seem to tell of the heading what nothing measured (Huang, Mourikis,
Roumeliotis, International Journal of Robotics Research 29(5), 2010).

iSAM2 never linearises anew what marginal factors are on, as these cannot follow. But far from the estimate a factor means nothing.
So ours are linearised at the estimate there, too, with the nearest Jacobian that agrees with the marginal factors on such turns
(Hesch, Kottas, Bowman, Roumeliotis, IEEE Transactions on Robotics 30(1), 2014, section V). That is a smaller change if all that is
held may follow the estimates by one translation, which leaves what marginal factors tell of turns as it is.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter

import gtsam
import numpy as np

from factorgraph_loc.fusion.graph.variables import Node, Values, frame_motions, is_place, is_pose, read, to_gtsam
from factors.graph import gaussian_factor, jacobian_factors
from factors.se2 import Array


class LinearFactors:
    """Our factors in a solver, and where that linearises its variables: those that moved as far as ``threshold``, at each update
    whose number ``skip`` divides. ``on_failure`` is called with the reason where a factor cannot be linearised, which is then left
    out."""

    def __init__(self, threshold: float, skip: int, on_failure: Callable[[str], None]) -> None:
        self._threshold, self._skip, self._on_failure = threshold, skip, on_failure
        self._updates = 0
        self.at: Values = {}  # where each variable is linearised
        self._held: Values = {}  # places that iSAM2 does not move: where it has them, but for a translation of all
        self._on: defaultdict[int, dict[int, _Linear]] = defaultdict(dict)  # the factors on each, by their identity
        self._slots: set[int] = set()
        self._added: list[_Linear] = []  # those of the last update, with their places in it as slots

    def added(
        self,
        solver: gtsam.ISAM2 | gtsam.IncrementalFixedLagSmoother,
        factors: Sequence[gtsam.NonlinearFactor],
        nodes: Sequence[Node],
        values: Values,
    ) -> tuple[gtsam.NonlinearFactorGraph, list[int]]:
        """All that the next update is to add, which is to be told by :meth:`place`, and the slots of what it is to remove: factors
        on variables that it will linearise elsewhere are replaced."""
        self._updates += 1
        self._added = self._moved(solver) if self.at and not self._updates % self._skip else []
        removed = [linear.slot for linear in self._added] if self._added else []
        self._slots.difference_update(removed)
        self.at |= values
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors:
            graph.add(factor)
        for node in nodes:
            if node.native is not None:
                graph.add(node.native)
                continue
            linear = _Linear(node)
            self._added.append(linear)
            for key in node.keys:
                self._on[key][id(linear)] = linear
        ours = list(map(_PLACED, self._added))
        for linear, linearized in zip(self._added, jacobian_factors(ours, self.at, self._on_failure), strict=True):
            linear.slot = graph.size()
            keys = linear.node.keys
            # a factor does without the point that it is linearised at where the solver never leaves that
            held = self._held and not self._held.keys().isdisjoint(keys)
            graph.add(self._on_held(keys, linearized) if held else gtsam.LinearContainerFactor(linearized))
        return graph, removed

    def _on_held(self, keys: Sequence[int], linearized: gtsam.GaussianFactor) -> gtsam.LinearContainerFactor:
        """A linearised factor on what the solver holds, with the point that it is linearised at."""
        jacobian, right = linearized.jacobian()
        motions, ends = frame_motions({key: self._held.get(key, self.at[key]) for key in keys})
        if sum(map(is_place, keys)) > 1:  # else it tells where the place is in the world
            jacobian = unaware(jacobian, motions)
        factor = gaussian_factor(keys, -right, np.split(jacobian, ends[:-1], axis=1))
        return gtsam.LinearContainerFactor(factor, to_gtsam({key: self.at[key] for key in keys}))

    def place(self, slots: Sequence[int]) -> None:
        """Take where the solver has put what was added."""
        for linear in self._added:
            linear.slot = slots[linear.slot]
            self._slots.add(linear.slot)

    def forget(self, key: int) -> None:
        """A variable has left the solver, with all factors on it."""
        del self.at[key]
        self._held.pop(key, None)
        for linear in self._on.pop(key, {}).values():
            self._slots.discard(linear.slot)
            for other in linear.node.keys:
                if other != key:
                    self._on[other].pop(id(linear), None)

    @property
    def framed(self) -> Values:
        """Where a new solver is to linearise the variables, with what is held as far from each other as it was then."""
        return self.at | self._held

    @property
    def slots(self) -> frozenset[int]:
        """Where they are in the solver."""
        return frozenset(self._slots)

    def _moved(self, solver: gtsam.ISAM2 | gtsam.IncrementalFixedLagSmoother) -> list[_Linear]:
        """Those that are to be linearised anew."""
        keys, ends = list(self.at), np.cumsum([len(value) for value in self.at.values()])
        change = np.maximum.reduceat(np.abs(solver.getDelta().vector(keys)), np.append(0, ends[:-1]))
        moved = [keys[i] for i in np.flatnonzero(change >= self._threshold).tolist()]
        if not moved:
            return []
        isam = solver if isinstance(solver, gtsam.ISAM2) else solver.getISAM2()
        fixed = isam.getFixedVariables()  # what marginal factors are on
        anew = [key for key in moved if not fixed.count(key)]
        self.at |= {key: read(solver, key) for key in anew}
        anew += self._followed({key: read(solver, key) for key in keys if is_place(key) and fixed.count(key)})
        return list({number: linear for key in anew for number, linear in self._on.get(key, {}).items()}.values())

    def _followed(self, held: Values) -> list[int]:
        """Of the places that iSAM2 holds, given their estimates, those whose factors are to be linearised anew.

        None if they are poses only: in a known map GTSAM's factors of the odometry stay behind."""
        if all(map(is_pose, held)):
            return []
        for key in held:
            self._held.setdefault(key, self.at[key])
        way = np.mean([held[key][:2] - self._held[key][:2] for key in held], axis=0)
        moved = {key: now for key, now in held.items() if np.abs(now - self.at[key]).max() >= self._threshold}
        if np.abs(way).max() >= self._threshold:
            self._held |= {key: np.append(self._held[key][:2] + way, self._held[key][2:]) for key in held}
            moved = held
        self.at |= moved
        return list(moved)


@dataclass(slots=True, eq=False)
class _Linear:
    """One of our factors, and its slot in the solver."""

    node: Node
    slot: int = -1


_PLACED = attrgetter("node.factor", "node.keys", "node.rows")


def unaware(jacobian: Array, motions: Array) -> Array:
    """The matrix nearest to a ``jacobian`` (m, n) that tells nothing of any of the ``motions`` (n, 3) of its variables (Hesch,
    Kottas, Bowman, Roumeliotis, IEEE Transactions on Robotics 30(1), 2014, section V)."""
    basis = np.linalg.qr(motions)[0]
    return np.asarray(jacobian - jacobian @ basis @ basis.T)

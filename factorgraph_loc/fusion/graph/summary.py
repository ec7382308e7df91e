"""What the graph of a window knows of what has left it.

GTSAM marginalises a variable into linear factors on those that it shared factors with. They and the priors hold all that the
window's own measurements do not contain, correlations included: a rebuilt window begins with them. Marginals of single variables
in their place would count the measurements among them twice, and lose their correlations.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import gtsam

from factorgraph_loc.fusion.graph.graph import Node
from factors.graph import Values, index_of, is_of_keyframe, is_pose, to_gtsam

KINDS = (gtsam.LinearContainerFactor, gtsam.PriorFactorPose2, gtsam.PriorFactorVector)


def oldest_pose(keys: Iterable[int]) -> int:
    """The index of the oldest pose among ``keys``, 0 if there is none."""
    return min((index_of(key) for key in keys if is_pose(key)), default=0)


@dataclass(frozen=True)
class MarginalSummary:
    """``factors``: marginal ones, and priors; ``keys`` of all variables of the graph; ``at``: where each is linearised."""

    factors: tuple[gtsam.NonlinearFactor, ...]
    keys: frozenset[int]
    at: Values

    @classmethod
    def of(
        cls, graph: gtsam.NonlinearFactorGraph, held: gtsam.Values, at: Values, ours: Collection[int] = ()
    ) -> MarginalSummary:
        """Of a graph that iSAM2 has linearised where it ``held`` the variables, to be linearised ``at`` there. ``ours``: places of
        factors of our own, which are not marginal ones."""
        every = (graph.at(i) for i in range(graph.size()) if i not in ours)
        there = to_gtsam(at)

        def placed(factor: gtsam.LinearContainerFactor) -> gtsam.LinearContainerFactor:
            """iSAM2 never moves what a marginal factor is on, and so gives it no place: elsewhere it needs one."""
            return gtsam.LinearContainerFactor(
                gtsam.LinearContainerFactor(factor.factor(), held).linearize(there), there
            )

        kept = tuple(
            placed(f) if isinstance(f, gtsam.LinearContainerFactor) else f for f in every if isinstance(f, KINDS)
        )
        return cls(kept, frozenset(graph.keyVector()), at)

    @property
    def oldest(self) -> int:
        """The index of the oldest pose."""
        return oldest_pose(self.keys)

    def before(self, pose: int) -> MarginalSummary:
        """What is left once the poses from the index ``pose`` on are taken back: others come under their keys."""
        kept = frozenset(key for key in self.keys if not is_of_keyframe(key) or index_of(key) < pose)
        return MarginalSummary(tuple(self.on(kept)), kept, {key: self.at[key] for key in kept})

    def on(self, present: Collection[int]) -> list[gtsam.NonlinearFactor]:
        """The factors on variables that are ``present``, with all that those on others tell of these."""
        kept: list[gtsam.NonlinearFactor] = []
        linear, gone, at = gtsam.GaussianFactorGraph(), set[int](), to_gtsam(self.at)
        for factor in self.factors:
            absent = [key for key in factor.keys() if key not in present]  # noqa: SIM118
            gone.update(absent)
            if absent:
                linear.add(factor.linearize(at))
            else:
                kept.append(factor)
        if gone:
            order = gtsam.Ordering()
            for key in sorted(gone):
                order.push_back(key)
            _, rest = linear.eliminatePartialMultifrontal(order)
            kept += [gtsam.LinearContainerFactor(rest.at(i), at) for i in range(rest.size())]
        return kept


def is_missing(node: Node, present: Collection[int], known: Collection[int]) -> bool:
    """Whether a factor is to be added to a graph of the variables ``present``, of which a summary tells those that are ``known``:
    it holds priors of what is no pose, and what hangs on a pose that is gone."""
    if any(key not in present for key in node.keys):
        return False
    return node.has_pose or node.keys[0] not in known

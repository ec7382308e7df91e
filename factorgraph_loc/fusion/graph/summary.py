"""The information that a window keeps on marginalised variables.

GTSAM marginalises a variable into linear factors on its neighbours in the graph. These factors and the priors contain all
information outside of the window's own measurements, correlations included. A rebuilt window begins with them. Marginals of single
variables would count common measurements twice, and lose the correlations.
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
    """``factors``: marginal ones, and priors; ``keys`` of all variables of the graph; ``at``: their linearisation points."""

    factors: tuple[gtsam.NonlinearFactor, ...]
    keys: frozenset[int]
    at: Values

    @classmethod
    def of(
        cls, graph: gtsam.NonlinearFactorGraph, points: gtsam.Values, at: Values, ours: Collection[int] = ()
    ) -> MarginalSummary:
        """The summary of a graph. ``points``: linearisation points of iSAM2; ``at``: those of the summary; ``ours``: slots of our
        factors, which are not marginal."""
        every = (graph.at(i) for i in range(graph.size()) if i not in ours)
        values = to_gtsam(at)

        def placed(factor: gtsam.LinearContainerFactor) -> gtsam.LinearContainerFactor:
            """The factor with linearisation points, which it lacks in iSAM2: there its variables are never linearised again."""
            return gtsam.LinearContainerFactor(
                gtsam.LinearContainerFactor(factor.factor(), points).linearize(values), values
            )

        kept = tuple(
            placed(f) if isinstance(f, gtsam.LinearContainerFactor) else f for f in every if isinstance(f, KINDS)
        )
        return cls(kept, frozenset(graph.keyVector()), at)

    @property
    def oldest(self) -> int:
        """The index of the oldest pose."""
        return oldest_pose(self.keys)

    def before_pose(self, pose: int) -> MarginalSummary:
        """The summary without the poses from the index ``pose`` on. Their keys are used again."""
        kept = frozenset(key for key in self.keys if not is_of_keyframe(key) or index_of(key) < pose)
        return MarginalSummary(tuple(self.on(kept)), kept, {key: self.at[key] for key in kept})

    def on(self, present: Collection[int]) -> list[gtsam.NonlinearFactor]:
        """The factors on the variables ``present``. All others are marginalised out."""
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
    """Whether a graph of the variables ``present`` needs a factor in addition to its summary. ``known``: variables of the summary,
    which contains priors of all variables but poses, and factors on poses that have left."""
    if any(key not in present for key in node.keys):
        return False
    return any(map(is_pose, node.keys)) or node.keys[0] not in known

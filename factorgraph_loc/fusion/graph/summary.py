"""The information that a fixed-lag smoother (window) has on marginalised variables, to rebuild the window after a failure.

GTSAM replaces a marginalised variable by linear factors on its neighbours in the graph. These marginal factors and the priors
contain all information except the measurements in the window, including correlations. A rebuilt window begins with them. Marginal
covariances of single variables would not be enough: they would count common measurements twice, and lose the correlations.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import gtsam

from factorgraph_loc.fusion.graph.graph import Node
from factors.graph import Values, index_of, is_of_keyframe, is_pose, to_gtsam

KINDS = (gtsam.LinearContainerFactor, gtsam.PriorFactorPose2, gtsam.PriorFactorVector)  # marginal factors and priors


def oldest_pose(keys: Iterable[int]) -> int:
    """Return the index of the oldest pose among ``keys``, 0 if there is none."""
    return min((index_of(key) for key in keys if is_pose(key)), default=0)


@dataclass(frozen=True)
class MarginalSummary:
    """The marginal factors that replace the removed (marginalised) variables of a fixed-lag smoother, and the priors.

    ``factors``: marginal factors and priors. ``keys``: the keys of the smoother's variables. ``at``: their
    linearisation points by key.
    """

    factors: tuple[gtsam.NonlinearFactor, ...]
    keys: frozenset[int]
    at: Values

    @classmethod
    def of(
        cls, graph: gtsam.NonlinearFactorGraph, points: gtsam.Values, at: Values, ours: Collection[int] = ()
    ) -> MarginalSummary:
        """Return the marginal factors and priors in a solver's ``graph``. ``points``: the linearisation points of
        iSAM2. ``at``: the linearisation points of the result. ``ours``: the indices in ``graph`` of the factors of
        measurements, which are left out."""
        every = (graph.at(i) for i in range(graph.size()) if i not in ours)
        values = to_gtsam(at)

        def placed(factor: gtsam.LinearContainerFactor) -> gtsam.LinearContainerFactor:
            """Return the marginal factor ``factor``, linearised at ``at`` instead of the linearisation points of
            iSAM2."""
            return gtsam.LinearContainerFactor(
                gtsam.LinearContainerFactor(factor.factor(), points).linearize(values), values
            )

        kept = tuple(
            placed(f) if isinstance(f, gtsam.LinearContainerFactor) else f for f in every if isinstance(f, KINDS)
        )
        return cls(kept, frozenset(graph.keyVector()), at)

    @property
    def oldest(self) -> int:
        """The index of the oldest pose among the variables."""
        return oldest_pose(self.keys)

    def before_pose(self, pose: int) -> MarginalSummary:
        """Return the summary of only the poses with an index below ``pose`` and of all other variables. Later poses are
        marginalised out. Call this before their keys are used for new poses."""
        kept = frozenset(key for key in self.keys if not is_of_keyframe(key) or index_of(key) < pose)
        return MarginalSummary(tuple(self.on(kept)), kept, {key: self.at[key] for key in kept})

    def on(self, present: Collection[int]) -> list[gtsam.NonlinearFactor]:
        """Return factors on only the variables ``present`` (keys). All other variables of the summary are marginalised
        out."""
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
    """Return True if a rebuilt fixed-lag smoother needs the factor ``node`` in addition to its summary of removed
    variables.

    ``present``: the keys of the smoother's variables. ``known``: the keys of the summary's variables. The summary
    contains the priors of its variables except poses, and the factors on removed poses.
    """
    if any(key not in present for key in node.keys):
        return False
    return any(map(is_pose, node.keys)) or node.keys[0] not in known

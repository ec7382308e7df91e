"""What an estimator tells at the ticks of a run."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from factorgraph_loc.model.belief import PoseEstimate, SpacePose, Status
from factorgraph_loc.model.trajectory3 import Trajectory3
from factors.se2 import Array


@dataclass
class CausalEstimates:
    """The estimates at the ticks, as columns: a few objects less for each tick."""

    t: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    status: list[Status] = field(default_factory=list)
    space: list[tuple[float, SpacePose]] = field(default_factory=list)  # of those that are localized

    def add(self, t: float, e: PoseEstimate) -> None:
        """Take an estimate with the tick's time, as an unlocalized one has none; copied, as an estimator may reuse its arrays."""
        self.t.append(t)
        self.poses.append(np.array(e.pose, dtype=float))
        self.covariances.append(np.array(e.covariance, dtype=float))
        self.status.append(e.status)
        if e.space is not None and e.status == "localized":
            self.space.append((t, e.space))

    def in_space(self) -> Trajectory3 | None:
        """The poses in space; None if there are none."""
        if not self.space:
            return None
        t, poses = zip(*self.space, strict=True)
        parts = (np.array([getattr(p, name) for p in poses]) for name in ("position", "rotation", "covariance"))
        return Trajectory3(np.array(t), *parts)

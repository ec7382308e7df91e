"""What an estimator tells at the ticks of a run."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from factorgraph_loc.model.belief import PoseEstimate, Status
from factors.se2 import Array


@dataclass
class CausalEstimates:
    """The estimates at the ticks, as columns: a few objects less for each tick."""

    t: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    status: list[Status] = field(default_factory=list)

    def add(self, t: float, e: PoseEstimate) -> None:
        """Take an estimate with the tick's time, as an unlocalized one has none; copied, as an estimator may reuse its arrays."""
        self.t.append(t)
        self.poses.append(np.array(e.pose, dtype=float))
        self.covariances.append(np.array(e.covariance, dtype=float))
        self.status.append(e.status)

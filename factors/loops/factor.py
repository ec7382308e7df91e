"""The factor of a loop closure between two poses. The loop closure may be false, so the factor has a robust loss.

The measurement is the later pose in the frame of the earlier pose, or only that both have the same position. The loss is that of
Geman and McClure. Its scale may be increased in the first iterations: graduated non-convexity (Yang, Antonante, Tzoumas, Carlone,
RA-L 5(2), 2020). This method finds the loop closures that agree with each other and with the odometry.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from factors import positive, se2
from factors.motion import Increment
from factors.odometry.factor import linearize
from factors.odometry.kernels import NO_CONSTANTS
from factors.robust import geman_mcclure_loss, geman_mcclure_weight
from factors.se2 import Array


@dataclass(frozen=True)
class LoopFactor:
    """A loop closure as a robust factor on two poses.

    ``measured`` (3,): the later pose in the frame of the earlier pose. None if the loop closure only states that both
    positions are equal.
    ``sigmas``: standard deviations (3,) [m, m, rad] of the body-frame perturbation of ``measured``. If ``measured`` is
    None, the standard deviation (1,) [m] of each coordinate of the difference of the positions.
    ``offset``: the motion from the later estimated pose to the pose at the time of the loop closure. Its covariance is
    added to the noise. None if both poses are equal. ``earlier_offset``: the same for the earlier pose.
    ``robust``: scale of the loss in standard deviations.

    The methods take ``values``, a list of the later pose (3,) and the earlier pose (3,).
    """

    measured: Array | None
    sigmas: Array
    offset: Increment | None = None
    earlier_offset: Increment | None = None
    robust: float = 3.0

    @property
    def rows(self) -> int:
        """The number of residuals: 3, or 2 if the loop closure only states that both positions are equal."""
        return 2 if self.measured is None else 3

    def linearize(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return the whitened residual (2,) or (3,) with robust weight, and a list of its Jacobians by the two poses.
        ``values``: the later pose (3,) and the earlier pose (3,)."""
        error, by_later, by_earlier = self.whitened(values)
        weight = math.sqrt(geman_mcclure_weight(float(error @ error), self.robust))
        return weight * error, [weight * by_later, weight * by_earlier]

    def whitened(self, values: Sequence[Array]) -> tuple[Array, Array, Array]:
        """Return the whitened residual (2,) or (3,), its Jacobian by the later pose, and its Jacobian by the earlier
        pose, without robust weights. ``values``: the later pose (3,) and the earlier pose (3,)."""
        moved = [None if o is None else o.delta for o in (self.offset, self.earlier_offset)]
        later, earlier = (v if o is None else se2.compose(v, o) for v, o in zip(values, moved, strict=True))
        if self.measured is not None:
            error, by_earlier, by_later, _ = linearize(earlier, later, self.measured, NO_CONSTANTS, self._whitener)
        else:
            x, y, turned = se2.between(earlier, later).tolist()
            c, s = math.cos(turned), math.sin(turned)
            error = self._whitener @ (x, y)
            by_later = self._whitener @ ((c, -s, 0.0), (s, c, 0.0))
            by_earlier = self._whitener @ ((-1.0, 0.0, y), (0.0, -1.0, -x))
        by_later, by_earlier = (
            block if offset is None else block @ se2.adjoint(se2.inverse(offset))
            for block, offset in zip((by_later, by_earlier), moved, strict=True)
        )
        return error, by_later, by_earlier

    def cost(self, values: Sequence[Array]) -> float:
        """Return the robust loss. ``values``: the later pose (3,) and the earlier pose (3,)."""
        error, _, _ = self.whitened(values)
        return float(geman_mcclure_loss(float(error @ error), self.robust))

    def widened(self, width: float) -> LoopFactor:
        """Return the factor with the scale of its robust loss multiplied by ``width``."""
        return replace(self, robust=width * self.robust)

    def convex_width(self, values: Sequence[Array]) -> float:
        """Return the smallest ``width`` >= 1 of :meth:`widened` that makes the loss convex at the poses ``values``."""
        error, _, _ = self.whitened(values)
        return max(1.0, math.sqrt(3.0) * float(np.linalg.norm(error)) / self.robust)

    @cached_property
    def _whitener(self) -> Array:
        """Return the matrix that whitens the residual. If only positions are measured, the noise is isotropic."""
        covariances = [o.covariance for o in (self.offset, self.earlier_offset) if o is not None]
        if self.measured is None:
            added = sum(float(np.trace(covariance[:2, :2])) / 2.0 for covariance in covariances)
            return np.eye(2) / math.sqrt(float(self.sigmas[0]) ** 2 + added)
        noise = np.diag(np.asarray(self.sigmas, dtype=float) ** 2)
        if self.offset is not None:
            noise = noise + self.offset.covariance
        if self.earlier_offset is not None:
            back = se2.adjoint(se2.inverse(self.measured))
            noise = noise + back @ self.earlier_offset.covariance @ back.T
        return positive.whitener(noise)

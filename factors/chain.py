"""Linear least squares for a chain of poses. Each residual depends on one pose or on two consecutive poses, and on
parameters that all residuals have in common. The solution is a compiled block elimination along the chain (Golub, van
Loan, "Matrix Computations", section 4.5). Marginal covariances follow by back substitution.

GTSAM's elimination has the same result but is slower, because each factor of each iteration becomes an object. A batch solution of
the data set plaza2 takes 2.1 s with GTSAM and 0.7 s with this module. A smoother takes a quarter more time with GTSAM.

There are N poses, P parameters and M residuals. ``first`` (M,) is the index of the first pose that each residual depends on. A row
of the Jacobian (M, 6 + P) has the derivatives by that pose (3), by the next pose (3), and by the parameters (P).
"""

import numpy as np

from factors import gaussian
from factors.compiled import compiled
from factors.gaussian import inverse, product, product_by_transpose, put
from factors.se2 import Array, Integers

POSE = 3
LEAST = 1e-11  # a matrix counts as singular if a pivot is below this fraction of the original diagonal element

# The normal equations as four blocks of the information matrix. Two of them contain the gradient in their last column:
# - each pose with itself (N, 3, 3);
# - each pose with the next pose (N, 3, 3);
# - each pose with the parameters, and the gradient by the pose (N, 3, P + 1);
# - the parameters with each other, and the gradient by the parameters (P + 1, P + 1). Its last row is unused.
System = tuple[Array, Array, Array, Array]


@compiled
def normal(count: int, first: Integers, jacobian: Array, residual: Array) -> System:
    """Return the normal equations of ``count`` (N) poses and P parameters, from M residuals (M,).

    ``first`` (M,): the index of the first pose that each residual depends on. ``jacobian`` (M, 6 + P): the derivatives
    of the residuals with respect to this pose, the next pose, and the parameters.

    Returns four blocks of the information matrix. The first two are of each pose (N, 3, 3), and of each pose and the
    next pose (N, 3, 3). The third is of each pose and the parameters (N, 3, P + 1). The fourth is of the parameters (P
    + 1, P + 1). The last column of the third and fourth is the gradient.
    """
    shared = jacobian.shape[1] - 2 * POSE
    own, coupling = np.zeros((count, POSE, POSE)), np.zeros((count, POSE, POSE))
    side, corner = np.zeros((count, POSE, shared + 1)), np.zeros((shared + 1, shared + 1))
    for m in range(len(residual)):
        row, error = jacobian[m], residual[m]
        for part in range(2):  # the first pose, and the next one
            i = first[m] + part
            for a in range(POSE):
                value = row[POSE * part + a]
                if value != 0.0:
                    side[i, a, shared] += value * error
                    for b in range(POSE):
                        own[i, a, b] += value * row[POSE * part + b]
                        if part == 0:
                            coupling[i, a, b] += value * row[POSE + b]
                    for b in range(shared):
                        side[i, a, b] += value * row[2 * POSE + b]
        for a in range(shared):
            value = row[2 * POSE + a]
            if value != 0.0:
                corner[a, shared] += value * error
                for b in range(shared):
                    corner[a, b] += value * row[2 * POSE + b]
    return own, coupling, side, corner


@compiled
def _inverted(block: Array, out: Array) -> bool:
    """Write the inverse of a symmetric positive definite ``block`` (3, 3) into ``out`` (3, 3). Returns False if the
    block is numerically singular."""
    a, b, c = block[0, 0], block[1, 0], block[2, 0]
    if not a > 0.0:
        return False
    p, q = b / a, c / a
    d, e = block[1, 1] - p * b, block[2, 1] - p * c
    if not d > LEAST * block[1, 1]:
        return False
    r = e / d
    f = block[2, 2] - q * c - r * e
    if not f > LEAST * block[2, 2]:
        return False
    # the inverse of the unit lower triangular factor of block = L D L^T has the rows (1, 0, 0), (-p, 1, 0), (p r - q, -r, 1)
    s = p * r - q
    out[0, 0] = 1.0 / a + p * p / d + s * s / f
    out[0, 1] = out[1, 0] = -p / d - s * r / f
    out[1, 1] = 1.0 / d + r * r / f
    out[0, 2] = out[2, 0] = s / f
    out[1, 2] = out[2, 1] = -r / f
    out[2, 2] = 1.0 / f
    return True


@compiled
def _subtract(left: Array, right: Array, out: Array) -> None:
    """Subtract the product of the transpose of ``left`` (3, C) and ``right`` (3, D) from ``out`` (C, D), in place."""
    for a in range(POSE):
        for j in range(left.shape[1]):
            for k in range(right.shape[1]):
                out[j, k] -= left[a, j] * right[a, k]


@compiled
def _eliminated(system: System, damping: float) -> tuple[bool, Array, Array, Array, Array]:
    """Eliminate the N poses of ``system`` in order, after multiplying the diagonal by ``1 + damping``.

    Returns True if the poses are determined, and four arrays to use in the back substitution. The first is the inverse
    of each pose's reduced diagonal block (N, 3, 3). The next two are this inverse times the block of the pose and the
    next pose (N, 3, 3), and times that of the pose, the parameters and the gradient (N, 3, P + 1). The last is the
    reduced block of the parameters (P + 1, P + 1).
    """
    own, coupling, side, corner = system
    count, shared = len(own), len(corner) - 1
    inverses, by_next, by_side = np.zeros_like(own), np.zeros_like(own), np.zeros_like(side)
    block, right, left = own[0].copy(), side[0].copy(), corner.copy()
    for i in range(shared):
        left[i, i] *= 1.0 + damping
    for i in range(count):
        for a in range(POSE):
            block[a, a] += damping * own[i, a, a]
        if not _inverted(block, inverses[i]):
            return False, inverses, by_next, by_side, left
        put(product(inverses[i], coupling[i]), by_next[i])
        put(product(inverses[i], right), by_side[i])
        _subtract(right, by_side[i], left)
        if i + 1 < count:
            block, right = own[i + 1].copy(), side[i + 1].copy()
            _subtract(coupling[i], by_next[i], block)
            _subtract(coupling[i], by_side[i], right)
    return True, inverses, by_next, by_side, left


@compiled
def solved(system: System, damping: float) -> tuple[bool, Array, Array]:
    """Solve the normal equations ``system`` (:func:`normal`) for a step, with the diagonal times ``1 + damping``.

    Returns three values: True if the poses are determined, the step of the poses (N, 3), and the step of the parameters
    (P,). The steps are zero if the first value is False. Raises LinAlgError if the parameters are not determined.
    """
    solvable, _, by_next, by_side, left = _eliminated(system, damping)
    shared, poses = len(left) - 1, np.zeros((len(by_side), POSE))
    step = np.zeros(shared)
    if solvable:
        right = np.empty((shared, 1))
        for k in range(shared):
            right[k, 0] = -left[k, shared]
        right, _ = gaussian.solved(left[:shared, :shared].copy(), right)
        for k in range(shared):
            step[k] = right[k, 0]
        for i in range(len(poses) - 1, -1, -1):
            for a in range(POSE):
                poses[i, a] = -by_side[i, a, shared]
                for k in range(shared):
                    poses[i, a] -= by_side[i, a, k] * step[k]
                if i + 1 < len(poses):
                    for k in range(POSE):
                        poses[i, a] -= by_next[i, a, k] * poses[i + 1, k]
    return solvable, poses, step


@compiled
def covariances(system: System) -> tuple[bool, Array, Array]:
    """Invert the information matrix of the normal equations ``system``, the result of :func:`normal`. Returns True if
    the poses are determined, the covariances of the poses (N, 3, 3), and the covariance of the parameters (P, P).
    Raises LinAlgError if the parameters are not determined."""
    solvable, out, by_next, by_side, left = _eliminated(system, 0.0)
    shared = len(left) - 1
    if not solvable:
        return False, out, left
    common = inverse(left[:shared, :shared].copy())
    for a in range(shared):
        for b in range(a):
            common[a, b] = common[b, a] = (common[a, b] + common[b, a]) / 2.0
    crossed = np.zeros((POSE, shared))  # the negative covariance of the pose and the parameters
    for i in range(len(out) - 1, -1, -1):
        by_shared = by_side[i, :, :shared].copy()
        cross = product(by_shared, common)
        # the part of this pose's covariance that comes from the errors of the next pose and of the parameters
        marginal = product_by_transpose(cross, by_shared)
        if i + 1 < len(out):
            beyond = product(by_next[i], crossed)
            both = product_by_transpose(beyond, by_shared)
            later = product_by_transpose(product(by_next[i], out[i + 1]), by_next[i])
            for a in range(POSE):
                for b in range(POSE):
                    marginal[a, b] += later[a, b] - both[a, b] - both[b, a]
                for k in range(shared):
                    cross[a, k] -= beyond[a, k]
        for a in range(POSE):
            for b in range(POSE):
                out[i, a, b] += (marginal[a, b] + marginal[b, a]) / 2.0
        crossed = cross
    return True, out, common

"""A linear least-squares problem of poses in a row: each residual depends on one pose, or on two that follow one another, and on
parameters that all have in common. Compiled: block elimination along the row, of which the cost grows with its length alone (Golub,
van Loan, "Matrix Computations", section 4.5), and the marginal covariances on the way back.

N poses, P parameters, M residuals. A row of a Jacobian (M, 6 + P) holds the derivatives by the ``first`` pose that the residual
depends on, by the next one, and by the parameters.
"""

import numpy as np

from factors import small_kernels
from factors.compiled import compiled
from factors.se2 import Array, Integers
from factors.small_kernels import inverse, product, product_by_transpose

POSE = 3
LEAST = 1e-11  # of a diagonal element: what elimination leaves below this share of it is a matter of rounding

# diagonal blocks (N, 3, 3); those by the next pose (N, 3, 3) and by the parameters (N, 3, P); that of the parameters (P, P);
# and the gradient, (N, 3) and (P,)
System = tuple[Array, Array, Array, Array, Array, Array]


@compiled
def normal(count: int, first: Integers, jacobian: Array, residual: Array) -> System:
    """The normal equations of ``count`` poses."""
    shared = jacobian.shape[1] - 2 * POSE
    own, after = np.zeros((count, POSE, POSE)), np.zeros((count, POSE, POSE))
    border, corner = np.zeros((count, POSE, shared)), np.zeros((shared, shared))
    gradient, common = np.zeros((count, POSE)), np.zeros(shared)
    for m in range(len(residual)):
        i, row, error = first[m], jacobian[m], residual[m]
        for a in range(POSE):
            if row[a] != 0.0:
                gradient[i, a] += row[a] * error
                for b in range(POSE):
                    own[i, a, b] += row[a] * row[b]
                    after[i, a, b] += row[a] * row[POSE + b]
                for b in range(shared):
                    border[i, a, b] += row[a] * row[2 * POSE + b]
            if row[POSE + a] != 0.0:
                gradient[i + 1, a] += row[POSE + a] * error
                for b in range(POSE):
                    own[i + 1, a, b] += row[POSE + a] * row[POSE + b]
                for b in range(shared):
                    border[i + 1, a, b] += row[POSE + a] * row[2 * POSE + b]
        for a in range(shared):
            if row[2 * POSE + a] != 0.0:
                common[a] += row[2 * POSE + a] * error
                for b in range(shared):
                    corner[a, b] += row[2 * POSE + a] * row[2 * POSE + b]
    return own, after, border, corner, gradient, common


@compiled
def _inverted(block: Array, out: Array) -> bool:
    """The inverse of a symmetric positive definite block (3, 3); False where rounding has left none."""
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
    # of the lower unit root: its inverse is (1, 0, 0), (-p, 1, 0), (p r - q, -r, 1)
    s = p * r - q
    out[0, 0] = 1.0 / a + p * p / d + s * s / f
    out[0, 1] = out[1, 0] = -p / d - s * r / f
    out[1, 1] = 1.0 / d + r * r / f
    out[0, 2] = out[2, 0] = s / f
    out[1, 2] = out[2, 1] = -r / f
    out[2, 2] = 1.0 / f
    return True


@compiled
def _multiply(left: Array, right: Array, out: Array) -> None:
    """Add ``left`` (3, 3) times ``right`` (3, D) to ``out`` (3, D)."""
    for a in range(POSE):
        for b in range(POSE):
            for k in range(right.shape[1]):
                out[a, k] += left[a, b] * right[b, k]


@compiled
def _subtract(left: Array, right: Array, out: Array) -> None:
    """Subtract the transpose of ``left`` (3, C) times ``right`` (3, D) from ``out`` (C, D)."""
    for a in range(POSE):
        for j in range(left.shape[1]):
            for k in range(right.shape[1]):
                out[j, k] -= left[a, j] * right[a, k]


@compiled
def _eliminated(system: System, damping: float) -> tuple[bool, Array, Array, Array, Array, Array, Array]:
    """Whether every pose can be eliminated in turn; the inverse block of each (N, 3, 3), that times its blocks by the next pose and
    by the parameters and times its gradient; and what is left of the parameters (P, P) and of their gradient (P,)."""
    own, after, border, corner, gradient, common = system
    count, shared = len(own), len(common)
    inverses, by_next = np.zeros((count, POSE, POSE)), np.zeros((count, POSE, POSE))
    by_shared, steps = np.zeros((count, POSE, shared)), np.zeros((count, POSE))
    block, carried, side, down = own[0].copy(), gradient[0].copy(), border[0].copy(), common.copy()
    left = corner.copy()
    for i in range(shared):
        left[i, i] += damping
    for i in range(count):
        for a in range(POSE):
            block[a, a] += damping
        if not _inverted(block, inverses[i]):
            return False, inverses, by_next, by_shared, steps, left, down
        _multiply(inverses[i], after[i], by_next[i])
        _multiply(inverses[i], side, by_shared[i])
        for a in range(POSE):
            for b in range(POSE):
                steps[i, a] += inverses[i, a, b] * carried[b]
        _subtract(side, by_shared[i], left)
        for a in range(POSE):
            for j in range(shared):
                down[j] -= side[a, j] * steps[i, a]
        if i + 1 < count:
            block, carried, side = own[i + 1].copy(), gradient[i + 1].copy(), border[i + 1].copy()
            _subtract(after[i], by_next[i], block)
            _subtract(after[i], by_shared[i], side)
            for a in range(POSE):
                for j in range(POSE):
                    carried[j] -= after[i, a, j] * steps[i, a]
    return True, inverses, by_next, by_shared, steps, left, down


@compiled
def solved(system: System, damping: float) -> tuple[bool, Array, Array]:
    """The step of Gauss and Newton, with ``damping`` added to the diagonal: of the poses (N, 3) and of the parameters (P,). The
    first value tells whether the problem determines them; LinAlgError where it is the parameters that are not determined."""
    found, _, by_next, by_shared, poses, left, shared = _eliminated(system, damping)
    if found:
        right = np.empty((len(shared), 1))
        for k in range(len(shared)):
            right[k, 0] = -shared[k]
        right, _ = small_kernels.solved(left, right)
        for k in range(len(shared)):
            shared[k] = right[k, 0]
        for i in range(len(poses) - 1, -1, -1):
            for a in range(POSE):
                poses[i, a] = -poses[i, a]
                for k in range(len(shared)):
                    poses[i, a] -= by_shared[i, a, k] * shared[k]
                if i + 1 < len(poses):
                    for k in range(POSE):
                        poses[i, a] -= by_next[i, a, k] * poses[i + 1, k]
    return found, poses, shared


@compiled
def covariances(system: System) -> tuple[bool, Array, Array]:
    """Marginal covariances of the poses (N, 3, 3) and of the parameters (P, P), as :func:`solved`."""
    found, out, by_next, by_shared, _, left, _ = _eliminated(system, 0.0)
    shared = len(left)
    if not found:
        return False, out, left
    common = inverse(left)
    for a in range(shared):
        for b in range(a):
            common[a, b] = common[b, a] = (common[a, b] + common[b, a]) / 2.0
    crossed = np.zeros((POSE, shared))  # the covariance of the pose and the parameters, negative
    for i in range(len(out) - 1, -1, -1):
        here = product(by_shared[i], common)
        # of what the next pose and the parameters make of this one
        spread = product_by_transpose(here, by_shared[i])
        if i + 1 < len(out):
            beyond = product(by_next[i], crossed)
            both = product_by_transpose(beyond, by_shared[i])
            later = product_by_transpose(product(by_next[i], out[i + 1]), by_next[i])
            for a in range(POSE):
                for b in range(POSE):
                    spread[a, b] += later[a, b] - both[a, b] - both[b, a]
                for k in range(shared):
                    here[a, k] -= beyond[a, k]
        for a in range(POSE):
            for b in range(POSE):
                out[i, a, b] += (spread[a, b] + spread[b, a]) / 2.0
        crossed = here
    return True, out, common

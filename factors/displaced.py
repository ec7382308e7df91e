"""Common parts of sighting factors: a pose variable at a known motion before the sighting, and additional noise."""

import numpy as np

from factors import positive, se2
from factors.se2 import Array


def displaced(
    error: Array, blocks: list[Array], offset: Array | None, spread: Array | None
) -> tuple[Array, list[Array]]:
    """Convert whitened residuals (K, 2) with Jacobians (K, 2, d), the first by the pose at the sighting, to those of a factor on
    the pose ``offset`` (3,) before it, with covariance ``spread`` (K, 2, 2) added to the unit noise; None for no change."""
    if spread is not None:
        whitener = positive.whitener(np.eye(2) + spread)
        error = np.einsum("kij,kj->ki", whitener, error)
        blocks = [whitener @ block for block in blocks]
    if offset is not None:
        blocks = [blocks[0] @ se2.adjoint(se2.inverse(offset)), *blocks[1:]]
    return error, blocks


def carried(jacobian: Array, covariance: Array) -> Array:
    """The covariance (K, 2, 2) of a ``covariance`` (..., d, d) propagated through a ``jacobian`` (K, 2, d)."""
    return np.asarray(jacobian @ covariance @ jacobian.transpose(0, 2, 1))


def common_error(jacobian: Array, covariance: Array, count: int | None = None) -> Array:
    """The covariance (K, 2, 2) added to each of ``count`` sightings (default K) for an error with ``covariance`` (d, d) that is
    common to all: multiplied by their number, so that it does not average out."""
    return (len(jacobian) if count is None else count) * carried(jacobian, covariance)


def delayed(offset: Array | None, twist: Array | None, seconds: float) -> Array | None:
    """The ``offset`` (3,) of a sighting that is ``seconds`` later, for a robot with velocity ``twist`` (3,)."""
    if twist is None or seconds == 0.0:
        return offset
    later = se2.exp(twist * seconds)
    return later if offset is None else se2.compose(offset, later)

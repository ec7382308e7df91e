"""Interpolation between evenly spaced knots of the grids and tables of detection models. The place of a value is its
distance from the first knot in units of the spacing."""

from typing import TypeVar

import numpy as np
from numba.extending import register_jitable

from factors.se2 import Array, Integers

Place = TypeVar("Place", float, Array)


def linear(place: Array, count: int) -> tuple[Integers, Array]:
    """Return the indices (N, 2) of neighbouring knots and their weights (N, 2), for linear interpolation. If ``count``
    is 1, both are (N, 1). ``count``: number of knots, at positions 0 ... ``count`` - 1. ``place`` (N,): the positions
    of the N results, clipped to this range."""
    if count == 1:
        return np.zeros((len(place), 1), dtype=np.int64), np.ones((len(place), 1))
    below = np.clip(np.floor(place).astype(np.int64), 0, count - 2)
    share = np.clip(place - below, 0.0, 1.0)
    return np.column_stack((below, below + 1)), np.column_stack((1.0 - share, share))


@register_jitable
def cubic_weights(f: Place) -> tuple[Place, Place, Place, Place]:
    """Return the weights of four consecutive knots in cubic convolution. ``f``: the position between the second knot
    (0) and the third knot (1), a number or an array."""
    return (
        ((-0.5 * f + 1.0) * f - 0.5) * f,
        (1.5 * f - 2.5) * f * f + 1.0,
        ((-1.5 * f + 2.0) * f + 0.5) * f,
        (0.5 * f - 0.5) * f * f,
    )


def cubic(place: Array, count: int) -> tuple[Integers, Array]:
    """Return the indices (N, 4) of neighbouring knots and their weights (N, 4), for cubic convolution (Keys, IEEE TASSP
    29(6), 1981, eq. 4, 6). If ``count`` is 1, both are (N, 1). ``count``: number of knots, at positions 0 ... ``count``
    - 1. ``place`` (N,): the positions of the N results, clipped to this range."""
    if count == 1:
        return np.zeros((len(place), 1), dtype=np.int64), np.ones((len(place), 1))
    below = np.clip(np.floor(place).astype(np.int64), 0, count - 2)
    f = np.clip(place - below, 0.0, 1.0)
    return np.clip(below[:, None] + np.arange(-1, 3), 0, count - 1), np.column_stack(cubic_weights(f))


def matrix(places: tuple[Integers, Array], count: int) -> Array:
    """Return the matrix (N, ``count``) that interpolates values at ``count`` knots to N positions. ``places``: the
    result of :func:`linear` or :func:`cubic`."""
    knots, weights = places
    out = np.zeros((len(knots), count))
    np.add.at(out, (np.arange(len(knots))[:, None], knots), weights)
    return out

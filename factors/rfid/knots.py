"""Interpolation between evenly spaced knots, as in :mod:`factors.rfid.model`, at N places."""

from typing import TypeVar

import numpy as np
from numba.extending import register_jitable

from factors.se2 import Array, Integers

Place = TypeVar("Place", float, Array)


def linear(place: Array, count: int) -> tuple[Integers, Array]:
    """Knots (N, 2) and weights of linear interpolation at places (N,) in steps of the knots; a single knot if there is only one."""
    if count == 1:
        return np.zeros((len(place), 1), dtype=np.int64), np.ones((len(place), 1))
    below = np.clip(np.floor(place).astype(np.int64), 0, count - 2)
    share = np.clip(place - below, 0.0, 1.0)
    return np.column_stack((below, below + 1)), np.column_stack((1.0 - share, share))


@register_jitable
def cubic_weights(f: Place) -> tuple[Place, Place, Place, Place]:
    """Weights of four knots for a position ``f`` in [0, 1] between the middle ones, in compiled code or of an array."""
    return (
        ((-0.5 * f + 1.0) * f - 0.5) * f,
        (1.5 * f - 2.5) * f * f + 1.0,
        ((-1.5 * f + 2.0) * f + 0.5) * f,
        (0.5 * f - 0.5) * f * f,
    )


def cubic(place: Array, count: int) -> tuple[Integers, Array]:
    """Knots (N, 4) and weights of cubic convolution (Keys, IEEE TASSP 29(6), 1981, eq. 4 and 6); a single knot if there is only
    one."""
    if count == 1:
        return np.zeros((len(place), 1), dtype=np.int64), np.ones((len(place), 1))
    below = np.clip(np.floor(place).astype(np.int64), 0, count - 2)
    f = np.clip(place - below, 0.0, 1.0)
    return np.clip(below[:, None] + np.arange(-1, 3), 0, count - 1), np.column_stack(cubic_weights(f))


def matrix(places: tuple[Integers, Array], count: int) -> Array:
    """The matrix (N, ``count``) from values at knots to those at N places."""
    knots, weights = places
    out = np.zeros((len(knots), count))
    np.add.at(out, (np.arange(len(knots))[:, None], knots), weights)
    return out

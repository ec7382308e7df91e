"""The inner loop of backward simulation: which particle a later state came from.

Godsill, Doucet, West, JASA 99(465), 2004, eq. 7: an ancestor is drawn with its weight times the transition density.
The kernel is compiled: in numpy it takes ten times as long, and most of the final result's time (``scripts/bench``).
"""

import math

import numpy as np
from numpy.typing import NDArray

from factors import positive
from factors.compiled import compiled
from factors.se2 import Array

Indices = NDArray[np.int64]


def draw_ancestors(
    predicted: Array,
    constants: Array,
    log_weights: Array,
    later: Array,
    later_constants: Array,
    covariance: Array,
    uniform: Array,
) -> Indices:
    """One index (M,) into the N particles for each later state.

    ``predicted`` (N, 3): the particles moved without noise; ``constants`` (N, P): their constants; ``log_weights`` (N,);
    ``later`` (M, 3) and ``later_constants`` (M, P): the later states; ``covariance`` (3+P, 3+P): of the pose's body-frame error and
    of the constants; ``uniform`` (M,): draws from [0, 1).
    """
    size = constants.shape[1]
    order = [*range(3, 3 + size), 0, 1, 2]  # of the constants first: what they whiten to is known before the loop
    whitener = np.linalg.inv(positive.root(covariance[np.ix_(order, order)]))
    by_constants = np.ascontiguousarray(whitener[:, :size].T)
    return np.asarray(
        _draw(
            predicted,
            np.ascontiguousarray((constants @ by_constants).T),
            log_weights,
            later,
            np.ascontiguousarray((later_constants @ by_constants).T),
            np.ascontiguousarray(whitener[size:, size:]),
            uniform,
        )
    )


@compiled
def _draw(
    predicted: Array,
    whitened: Array,
    log_weights: Array,
    later: Array,
    whitened_later: Array,
    whitener: Array,
    uniform: Array,
) -> Indices:
    """``whitened`` (P+3, N) and ``whitened_later`` (P+3, M): the constants' part of the whitened states; ``whitener`` (3, 3): of
    the pose's error given the constants."""
    count = len(predicted)
    size = len(whitened) - 3
    cosine, sine = np.empty(count), np.empty(count)
    for i in range(count):
        cosine[i], sine[i] = math.cos(predicted[i, 2]), math.sin(predicted[i, 2])
    density = np.empty(count)
    rows = np.empty(len(later), np.int64)
    for j in range(len(later)):
        # one loop per term: the compiler can then process several particles per instruction
        for i in range(count):
            dx, dy = later[j, 0] - predicted[i, 0], later[j, 1] - predicted[i, 1]
            along, lateral = cosine[i] * dx + sine[i] * dy, cosine[i] * dy - sine[i] * dx
            turn = later[j, 2] - predicted[i, 2]
            turn -= 2.0 * np.pi * np.floor((turn + np.pi) * (0.5 / np.pi))
            e0 = whitener[0, 0] * along + (whitened_later[size, j] - whitened[size, i])
            e1 = (
                whitener[1, 0] * along
                + whitener[1, 1] * lateral
                + (whitened_later[size + 1, j] - whitened[size + 1, i])
            )
            e2 = whitener[2, 0] * along + whitener[2, 1] * lateral + whitener[2, 2] * turn
            e2 += whitened_later[size + 2, j] - whitened[size + 2, i]
            density[i] = log_weights[i] - 0.5 * (e0 * e0 + e1 * e1 + e2 * e2)
        for p in range(size):
            for i in range(count):
                e0 = whitened_later[p, j] - whitened[p, i]
                density[i] -= 0.5 * e0 * e0
        highest = -np.inf
        for i in range(count):
            highest = max(highest, density[i])
        if not highest > -np.inf:  # so far away that no density is left: by the weights alone
            for i in range(count):
                density[i] = log_weights[i]
                highest = max(highest, density[i])
        total = 0.0
        for i in range(count):
            # far below the highest nothing is drawn, and exp is what takes time
            density[i] = np.exp(density[i] - highest) if density[i] > highest - 20.0 else 0.0
            total += density[i]
        threshold = uniform[j] * total
        reached = 0.0
        rows[j] = count - 1
        for i in range(count):
            reached += density[i]
            if reached > threshold:
                rows[j] = i
                break
    return rows

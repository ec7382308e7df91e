"""Compiled loops of :mod:`~factorgraph_loc.vision.association`, for thousands of points and hundreds of features."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled
from factors.se2 import Array

Integers = NDArray[np.int64]
NOWHERE = -1

BITS = np.array([bin(i).count("1") for i in range(256)], dtype=np.int64)


@compiled
def agreeing_views(
    rows: Integers, place: Array, positions: Array, starts: Integers, seen_from: Array, cosine: float, ratio: float
) -> tuple[Integers, Integers]:
    """Views of the points ``rows`` (C,) from viewpoints similar to ``place`` (3,): their indices, and the start of each point's
    views in these (C+1,). Views are stored by point, beginning at ``starts`` (P+1,)."""
    total = 0
    for row in rows:
        total += starts[row + 1] - starts[row]
    views = np.empty(total, np.int64)
    begins = np.empty(len(rows) + 1, np.int64)
    n = 0
    for i in range(len(rows)):
        begins[i] = n
        p = rows[i]
        ax, ay, az = place[0] - positions[p, 0], place[1] - positions[p, 1], place[2] - positions[p, 2]
        here = np.sqrt(ax * ax + ay * ay + az * az)
        for v in range(starts[p], starts[p + 1]):
            bx = seen_from[v, 0] - positions[p, 0]
            by = seen_from[v, 1] - positions[p, 1]
            bz = seen_from[v, 2] - positions[p, 2]
            there = np.sqrt(bx * bx + by * by + bz * bz)
            if here > ratio * there or there > ratio * here:
                continue
            if ax * bx + ay * by + az * bz >= cosine * here * there:
                views[n] = v
                n += 1
    begins[len(rows)] = n
    return views[:n], begins


@compiled
def gated_pairs(predicted: Array, inverses: Array, reaches: Array, features: Array, cell: float) -> Integers:
    """Pairs (N, 2) of a point and a feature inside the gate of the point's prediction.

    ``predicted`` (C, 2); ``inverses`` (C, 2, 2): inverse gate matrices (1 on the border); ``reaches`` (C,): largest radii;
    ``features`` (K, 2). ``cell``: size of the cells for sorting features.
    """
    low_x, low_y = high_x, high_y = features[0, 0], features[0, 1]
    for i in range(1, len(features)):
        low_x, low_y = min(low_x, features[i, 0]), min(low_y, features[i, 1])
        high_x, high_y = max(high_x, features[i, 0]), max(high_y, features[i, 1])
    columns, lines = int((high_x - low_x) / cell) + 1, int((high_y - low_y) / cell) + 1
    where = np.empty(len(features), np.int64)
    begins, used = np.zeros(columns * lines + 1, np.int64), np.zeros(columns * lines, np.int64)
    for i in range(len(features)):
        where[i] = int((features[i, 1] - low_y) / cell) * columns + int((features[i, 0] - low_x) / cell)
        begins[where[i] + 1] += 1
    for i in range(columns * lines):
        begins[i + 1] += begins[i]
    sorted_features = np.empty(len(features), np.int64)
    for i in range(len(features)):
        sorted_features[begins[where[i]] + used[where[i]]] = i
        used[where[i]] += 1
    pairs = np.empty((1024, 2), np.int64)
    n = 0
    for c in range(len(predicted)):
        u, v, reach = predicted[c, 0], predicted[c, 1], reaches[c]
        x0 = max(0, int(np.floor((u - reach - low_x) / cell)))
        x1 = min(columns - 1, int(np.floor((u + reach - low_x) / cell)))
        y0 = max(0, int(np.floor((v - reach - low_y) / cell)))
        y1 = min(lines - 1, int(np.floor((v + reach - low_y) / cell)))
        if x1 < x0:
            continue
        m = inverses[c]
        for y in range(y0, y1 + 1):
            for j in range(begins[y * columns + x0], begins[y * columns + x1 + 1]):
                f = sorted_features[j]
                du, dv = features[f, 0] - u, features[f, 1] - v
                if m[0, 0] * du * du + 2.0 * m[0, 1] * du * dv + m[1, 1] * dv * dv > 1.0:
                    continue
                if n == len(pairs):
                    longer = np.empty((2 * n, 2), np.int64)
                    for k in range(n):
                        longer[k, 0], longer[k, 1] = pairs[k, 0], pairs[k, 1]
                    pairs = longer
                pairs[n, 0], pairs[n, 1] = c, f
                n += 1
    return pairs[:n]


@compiled(fastmath=True)
def distances(pairs: Integers, begins: Integers, views: Integers, known: Any, seen: Any) -> Array:
    """Squared distance (N,) of each pair's feature (descriptors ``seen`` (K, D)) from the nearest of the point's views (``known``
    (V, D))."""
    out = np.empty(len(pairs))
    size = known.shape[1]
    for i in range(len(pairs)):
        best = np.float32(np.inf)
        f = seen[pairs[i, 1]]
        for j in range(begins[pairs[i, 0]], begins[pairs[i, 0] + 1]):
            k = known[views[j]]
            total = np.float32(0.0)
            for d in range(size):
                total += (f[d] - k[d]) * (f[d] - k[d])
            best = min(best, total)
        out[i] = best
    return out


@compiled
def bit_distances(pairs: Integers, begins: Integers, views: Integers, known: Any, seen: Any, bits: Integers) -> Array:
    """As :func:`distances`, with the Hamming distance."""
    out = np.empty(len(pairs))
    for i in range(len(pairs)):
        best = 1 << 30
        for j in range(begins[pairs[i, 0]], begins[pairs[i, 0] + 1]):
            total = 0
            for d in range(known.shape[1]):
                total += bits[seen[pairs[i, 1], d] ^ known[views[j], d]]
            best = min(best, total)
        out[i] = best
    return out


@compiled
def clear_pairs(
    pairs: Integers, costs: Array, predicted: Array, features: Array, ratio: float, apart: float
) -> Integers:
    """Indices of the pairs that are mutually nearest and pass the ratio test: a cost below ``ratio`` times that of the best other
    match at least ``apart`` pixels away."""
    count, amount = len(predicted), len(features)
    of_point, of_feature = np.full(count, NOWHERE), np.full(amount, NOWHERE)
    for i in range(len(pairs)):
        c, f = pairs[i]
        if of_point[c] == NOWHERE or costs[i] < costs[of_point[c]]:
            of_point[c] = i
        if of_feature[f] == NOWHERE or costs[i] < costs[of_feature[f]]:
            of_feature[f] = i
    clear = np.ones(len(pairs), np.bool_)
    square = apart * apart
    for i in range(len(pairs)):
        c, f = pairs[i]
        best = of_feature[f]
        if best != i and costs[best] >= ratio * costs[i]:
            b = pairs[best, 0]
            du, dv = predicted[b, 0] - predicted[c, 0], predicted[b, 1] - predicted[c, 1]
            if du * du + dv * dv > square:
                clear[best] = False
        best = of_point[c]
        if best != i and costs[best] >= ratio * costs[i]:
            b = pairs[best, 1]
            du, dv = features[b, 0] - features[f, 0], features[b, 1] - features[f, 1]
            if du * du + dv * dv > square:
                clear[best] = False
    out = np.empty(min(count, amount), np.int64)
    n = 0
    for c in range(count):
        i = of_point[c]
        if i != NOWHERE and of_feature[pairs[i, 1]] == i and clear[i]:
            out[n] = i
            n += 1
    return out[:n]


@compiled(error_model="numpy")
def nearest_owners(distances: NDArray[Any], starts: Integers, few: int) -> tuple[Integers, NDArray[Any], Integers]:
    """Of K owners of the columns of ``distances`` (N, M), those of owner k from ``starts`` (K + 1,) k on: the ``few`` nearest
    to each row, nearest first, with their distances (N, few); and the row (K,) that is nearest to each."""
    n, count = len(distances), len(starts) - 1
    owners, least = np.zeros((n, few), dtype=np.int64), np.full((n, few), np.inf, dtype=distances.dtype)
    rows, best = np.zeros(count, dtype=np.int64), np.full(count, np.inf, dtype=distances.dtype)
    for i in range(n):
        for k in range(count):
            distance = distances[i, starts[k]]
            for j in range(starts[k] + 1, starts[k + 1]):
                distance = min(distance, distances[i, j])
            if distance < best[k]:
                best[k], rows[k] = distance, i
            if not distance < least[i, few - 1]:
                continue
            place = few - 1
            while place > 0 and distance < least[i, place - 1]:
                least[i, place], owners[i, place] = least[i, place - 1], owners[i, place - 1]
                place -= 1
            least[i, place], owners[i, place] = distance, k
    return owners, least, rows

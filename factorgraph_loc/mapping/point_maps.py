"""Operations on whole maps of points: merging the maps of two drives, and thinning of dense maps.

Two points of different maps are considered the same point under three conditions. Their positions agree within their covariances.
Each is the most similar candidate of the other. Their views differ no more than views of one point of the first map. The errors of
both points may be correlated, for example if both maps were made with the same reference. Therefore they are fused by covariance
intersection with equal weights (Julier, Uhlmann, American Control Conference 1997), which is consistent for any correlation.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from factorgraph_loc.errors import InputError
from factorgraph_loc.maps.points import PointMap
from factorgraph_loc.vision.matching import distance_matrix
from factors import positive
from factors.se2 import Array, Integers

GATE = 16.27  # 99.9 % of chi-square with three degrees of freedom
FARTHEST = 0.5  # m: largest distance of two estimates of the same point
PERCENTILE = 90.0  # of the differences between views of one point: views that differ more show different points
COMPARED = 2000  # number of points in the estimate of this percentile
CELL = 0.5  # m: size of the cells of space; thinning keeps points in as many cells as possible
LEAST = 1e-6  # m: standard deviation that is added to all points, so that exact points can be compared


def merged(first: PointMap, second: PointMap) -> tuple[PointMap, int]:
    """Return the merged map of two maps, and the number of points that both maps have in common.

    Common points are recognised by the descriptors of their views, and keep their names in ``first``. The other points
    of ``second`` with views get new names. Points without views keep their names. Raises InputError if the maps have
    features of different kinds. Also raises InputError if a point of ``second`` without views has the name of a point
    of ``first``.
    """
    kinds = {points.feature for points in (first, second) if points.feature}
    if len(kinds) > 1:
        raise InputError(f"the maps have different kinds of features: {' and '.join(sorted(kinds))}, expected one kind")
    pairs = _same(first, second)
    old, new = pairs[:, 0], pairs[:, 1]
    positions, covariances = first.positions.copy(), first.covariances.copy()
    if len(pairs):
        informations = [
            positive.inverse(_covariances(points, which)) for points, which in ((first, old), (second, new))
        ]
        covariances[old] = positive.inverse((informations[0] + informations[1]) / 2.0)
        weighted = [
            i @ p[..., None] for i, p in zip(informations, (positions[old], second.positions[new]), strict=True)
        ]
        positions[old] = (covariances[old] @ ((weighted[0] + weighted[1]) / 2.0))[..., 0]
    fused = replace(first, positions=positions, covariances=covariances)
    new_only = np.setdiff1d(np.arange(len(second)), new)
    owners = np.full(len(second), -1, dtype=np.int64)
    owners[new], owners[new_only] = old, len(first) + np.arange(len(new_only))
    return _joined(fused, second, new_only, owners), len(pairs)


def thinned(points: PointMap, most: int) -> PointMap:
    """Return a map with all points without views, and at most ``most`` of the points with views.

    The points are taken from as many cells of a grid in space as possible. In each cell, the points with the smallest
    covariances are kept.
    """
    viewed = np.unique(points.owners)
    if len(viewed) <= most:
        return points
    sigma = positive.worst_sigma(points.covariances)
    cells = np.floor(points.positions[viewed] / CELL).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    order = np.lexsort((sigma[viewed], cell.ravel()))
    ordered = cell.ravel()[order]
    starts = np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1]))
    rank = np.empty(len(viewed), dtype=np.int64)
    rank[order] = np.arange(len(viewed)) - np.repeat(starts, np.diff(np.append(starts, len(viewed))))
    kept = viewed[np.lexsort((sigma[viewed], rank))[:most]]
    return points.chosen(np.sort(np.concatenate((kept, np.setdiff1d(np.arange(len(points)), viewed)))))


def _joined(first: PointMap, second: PointMap, added: Integers, owners: Integers) -> PointMap:
    """Return a map with all points of ``first``, the points of ``second`` with the indices ``added``, and the views of
    both.

    ``owners`` (P,): the index in the returned map of each of the P points of ``second``. Its views are assigned to this
    point.
    """
    named = {second.names[i] for i in np.setdiff1d(added, second.owners).tolist()}
    if double := sorted(named & set(first.names)):
        raise InputError(
            f"the point {double[0]} is in both maps but has no view to compare: rename it in one of the maps"
        )
    taken, number, names = {*first.names, *named}, 0, list(first.names)
    for i in added.tolist():
        name = second.names[i]
        while name in taken and name not in named:
            name, number = f"p{len(first) + number}", number + 1
        taken.add(name)
        names.append(name)
    parts = [points for points in (first, second) if len(points.owners)] or [first]
    return PointMap(
        tuple(names),
        np.concatenate((first.positions, second.positions[added])),
        np.concatenate((first.covariances, second.covariances[added])),
        first.feature or second.feature,
        np.concatenate((first.owners, owners[second.owners])),
        np.concatenate([points.descriptors for points in parts]),
        np.concatenate((first.seen_from, second.seen_from)),
        _common(first, second),
    )


def _common(first: PointMap, second: PointMap) -> Array | None:
    """Return the field ``common`` (V, 3, 3) of the joined map, the covariances of shared errors. They are those of
    ``first``, then those of ``second``, zero for a map without this field. Returns None if both maps lack it."""
    if first.common is None and second.common is None:
        return None
    return np.concatenate([np.zeros((len(p.owners), 3, 3)) if p.common is None else p.common for p in (first, second)])


def _same(first: PointMap, second: PointMap) -> Integers:
    """Return pairs (M, 2) of an index in ``first`` and an index in ``second`` that denote the same point. The positions
    of such points agree, and their most similar descriptors agree."""
    none = np.empty((0, 2), dtype=np.int64)
    if not (len(first.owners) and len(second.owners)):
        return none
    views, second_views = _views(first), _views(second)
    limit = _limit(first, views)
    near = cKDTree(second.positions).query_ball_point(first.positions, FARTHEST)
    rows = []
    for i, candidates in enumerate(near):
        which = np.array([j for j in candidates if len(second_views[j])], dtype=np.int64)
        if not len(views[i]) or not len(which):
            continue
        covariance = _covariances(second, which) + _covariances(first, np.array([i]))
        agree = positive.squared(second.positions[which] - first.positions[i], covariance) < GATE
        for j in which[agree].tolist():
            apart = distance_matrix(first.descriptors[views[i]], second.descriptors[second_views[j]])
            rows.append((float(apart.min()), i, j))
    pairs: list[tuple[int, int]] = []
    ours: set[int] = set()
    theirs: set[int] = set()
    for least, i, j in sorted(rows):
        if least <= limit and i not in ours and j not in theirs:
            pairs.append((i, j))
        ours.add(i)
        theirs.add(j)
    return np.array(sorted(pairs), dtype=np.int64) if pairs else none


def _views(points: PointMap) -> list[Integers]:
    """Return the indices of the views of each point, one array per point."""
    order = np.argsort(points.owners, kind="stable")
    return np.split(order, np.cumsum(np.bincount(points.owners, minlength=len(points)))[:-1])


def _limit(points: PointMap, views: list[Integers]) -> float:
    """Return the largest descriptor distance between views of the same point: the percentile :data:`PERCENTILE` of the
    distances between the two most similar views of each point. Returns 0 if no point has two views."""
    least = []
    for mine in [mine for mine in views if len(mine) > 1][:COMPARED]:
        apart = distance_matrix(points.descriptors[mine], points.descriptors[mine])
        least.append(float(apart[np.triu_indices(len(mine), 1)].min()))
    return float(np.percentile(least, PERCENTILE)) if least else 0.0


def _covariances(points: PointMap, which: Integers) -> Array:
    return points.covariances[which] + LEAST**2 * np.eye(3)

"""Maps of 3-D points with image descriptors, stored as ``NAME.points.parquet`` in the folder of a world file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import polars as pl
from numpy.typing import NDArray

from factorgraph_loc.errors import InputError, bad_field
from factorgraph_loc.files.columns import COVARIANCES, POINTS, UPPER, symmetric
from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.tables import read_parquet, text_column, write_parquet
from factorgraph_loc.files.temporary import writing
from factorgraph_loc.text import listed
from factors.positive import worst_sigma
from factors.se2 import Array, Integers

POINTS_SUFFIX = ".points.parquet"
COLUMNS = ("point", "x", "y", "z", "xx", "xy", "xz", "yy", "yz", "zz")
VIEW = ("from_x", "from_y", "from_z")
Feature = Literal["colour", "sift", "orb"]
KINDS: tuple[str, ...] = get_args(Feature)
LARGEST_VALUE = 1e6  # largest absolute value of an element of a descriptor
PLY = """ply
format ascii 1.0
comment points of a map in metres; sigma: standard deviation in the worst direction; views: stored views of a point
element vertex {count}
property double x
property double y
property double z
property double sigma
property int views
end_header
"""
ROUNDING = 1e-9  # rounding error of an eigenvalue, relative to the largest
ARM = 1.0  # m per rad: weight of directions against distances in the choice of the nearest camera position
LEAST = 0.01  # m: minimum standard deviation of a point after the common error is removed


@dataclass(frozen=True, eq=False)
class PointMap:
    """A map of P points in space, with V views. A view is one observation of one point in an image.

    ``names``: P unique names. ``positions`` (P, 3): in the world frame [m]. ``covariances`` (P, 3, 3) [m^2].
    ``feature``: the kind of ``descriptors`` (V, D), "" if points are identified only by name (V = 0). ``owners`` (V,):
    index of the point of each view. ``seen_from`` (V, 3): position of the camera at each view [m].
    ``common`` (V, 3, 3): covariance [m, rad] of the error of (x, y, heading) of the map near each of these cameras, see
    :class:`CommonError`. It is None if the camera's trajectory was known from a reference when the map was made.
    """

    names: tuple[str, ...]
    positions: Array
    covariances: Array
    feature: str
    owners: NDArray[np.int64]
    descriptors: NDArray[Any]
    seen_from: Array
    common: Array | None = None

    def __len__(self) -> int:
        return len(self.names)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, PointMap):
            return NotImplemented
        pairs = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return all(np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b for a, b in pairs)

    __hash__ = None  # type: ignore[assignment]

    @cached_property
    def index(self) -> dict[str, int]:
        """The index of each point by its name."""
        return {name: i for i, name in enumerate(self.names)}

    @classmethod
    def of(cls, names: Sequence[str], positions: Array, covariances: Array | None = None) -> PointMap:
        """Return a map of named points without descriptors. If ``covariances`` is None, the positions are exact."""
        spatial = np.zeros((len(names), 3, 3)) if covariances is None else covariances
        return cls(
            tuple(names),
            positions,
            spatial,
            "",
            np.empty(0, dtype=np.int64),
            np.empty((0, 0)),
            np.empty((0, 3)),
        )

    def chosen(self, which: Integers) -> PointMap:
        """Return a map with only the points with the indices ``which``, and their views."""
        place = np.full(len(self), -1, dtype=np.int64)
        place[which] = np.arange(len(which))
        views = np.flatnonzero(place[self.owners] >= 0)
        return PointMap(
            tuple(self.names[i] for i in which.tolist()),
            self.positions[which],
            self.covariances[which],
            self.feature if len(views) else "",
            place[self.owners[views]],
            self.descriptors[views],
            self.seen_from[views],
            None if self.common is None else self.common[views],
        )

    def with_points(self, added: PointMap, source: object) -> PointMap:
        """Return the map with the points ``added``, which have no views. ``source``: their file, for errors.

        Raises InputError if a name exists already.
        """
        if double := [name for name in added.names if name in self.index]:
            raise InputError(f"{source}: the point {double[0]} occurs twice, expected unique names")
        return replace(
            self,
            names=(*self.names, *added.names),
            positions=np.concatenate((self.positions, added.positions)),
            covariances=np.concatenate((self.covariances, added.covariances)),
        )


def write_points(points: PointMap, path: Path) -> None:
    """Write a map of points as a Parquet table: one row per view, and one row for each point without views."""
    viewed = np.zeros(len(points), dtype=bool)
    viewed[points.owners] = True
    unseen = np.flatnonzero(~viewed)
    rows = np.concatenate((points.owners, unseen))
    order = np.argsort(rows, kind="stable")
    rows, views = rows[order], np.concatenate((np.arange(len(points.owners)), np.full(len(unseen), -1)))[order]
    columns: dict[str, Any] = {"point": [points.names[i] for i in rows.tolist()]}
    columns |= {name: points.positions[rows, axis] for axis, name in enumerate("xyz")}
    columns |= {name: points.covariances[rows, i, j] for name, (i, j) in zip(COLUMNS[4:], UPPER, strict=True)}
    columns["feature"] = [points.feature if v >= 0 else "" for v in views.tolist()]
    if len(points.owners):
        shown = views >= 0
        for axis, name in enumerate(VIEW):
            columns[name] = np.where(shown, points.seen_from[views, axis], np.nan)
        if points.common is not None:
            entries = COVARIANCES.items()
            columns |= {name: np.where(shown, points.common[views, i, j], np.nan) for name, (i, j) in entries}
        columns["descriptor"] = [points.descriptors[v].tobytes() if v >= 0 else b"" for v in views.tolist()]
    write_parquet(pl.DataFrame(columns), path)


def read_points(path: Path) -> PointMap:
    """Return the map of points that :func:`write_points` wrote to ``path``.

    Raises InputError with file, row (counted from 1) and column of an invalid value. All rows of a point must have the
    same position. Covariances must be positive semi-definite.
    """
    table = read_parquet(path)
    missing = [name for name in (*COLUMNS, "feature") if name not in table.columns]
    if missing:
        raise InputError(f"{path}: has no column {missing[0]}, expected {', '.join((*COLUMNS, 'feature'))}")
    every = np.arange(len(table))
    numbers = {name: _numbers(table, name, every, path) for name in COLUMNS[1:]}
    rows: dict[str, int] = {}
    labels = text_column(table, "point", path)
    if "" in labels:
        raise bad_field(path, "point", "", "the name of a point", row=labels.index("") + 1)
    owner = np.array([rows.setdefault(name, len(rows)) for name in labels], dtype=np.int64)
    _, first = np.unique(owner, return_index=True)
    for name, values in numbers.items():
        expected = values[first][owner]
        if len(bad := np.flatnonzero(values != expected)):
            i = int(bad[0])
            stated = f"{float(expected[i])!r} as in row {first[owner[i]] + 1} of point {labels[i]}"
            raise bad_field(path, name, float(values[i]), stated, row=i + 1)
    positions = np.column_stack([numbers[axis] for axis in "xyz"])
    covariances = symmetric([numbers[name][first] for name in COLUMNS[4:]])
    _check_covariances(covariances, COLUMNS[4:], tuple(rows), first, path)
    features = text_column(table, "feature", path)
    kinds = sorted({name for name in features if name})
    if unknown := [name for name in kinds if name not in KINDS]:
        raise bad_field(path, "feature", unknown[0], " or ".join(KINDS), row=features.index(unknown[0]) + 1)
    if len(kinds) > 1:
        raise InputError(f"{path}: has features of the kinds {listed(kinds)}, expected one kind")
    if not kinds:
        return PointMap.of(tuple(rows), positions[first], covariances)
    shown = np.flatnonzero([bool(name) for name in features])
    common = None
    if any(name in table.columns for name in COVARIANCES):
        common = symmetric([_numbers(table, name, shown, path) for name in COVARIANCES])
        _check_covariances(common, tuple(COVARIANCES), [labels[i] for i in shown.tolist()], shown, path)
    return PointMap(
        tuple(rows),
        positions[first],
        covariances,
        kinds[0],
        owner[shown],
        _descriptors(table, shown, kinds[0], path),
        np.column_stack([_numbers(table, name, shown, path) for name in VIEW]),
        common,
    )


def _numbers(table: pl.DataFrame, name: str, rows: NDArray[np.int64], path: Path) -> Array:
    """Return the values (R,) of the column ``name`` in the rows with the indices ``rows`` (R,). Raises InputError if a
    value is out of bounds, or the column is missing. ``path``: the file in errors."""
    if name not in table.columns or not table[name].dtype.is_numeric():
        raise InputError(f"{path}: has no column {name} of numbers")
    values = np.asarray(table[name].cast(pl.Float64).to_numpy(), dtype=float)[rows]
    POINTS[name].require(path, rows + 1, values)
    return values


def _check_covariances(
    covariances: Array, columns: Sequence[str], names: Sequence[str], rows: NDArray[np.int64], path: Path
) -> None:
    """Raise InputError at the first of ``covariances`` (N, 3, 3) that is not positive semi-definite.

    ``columns``: of the covariance in the table of the file ``path``. ``names``, ``rows`` (N,): the point and the row of
    the table, counted from 0, of each covariance.
    """
    least, _, most = np.linalg.eigvalsh(covariances).T
    if len(bad := np.flatnonzero(least < -ROUNDING * np.abs(most))):
        i = int(bad[0])
        given = tuple(float(covariances[i][place]) for place in UPPER)
        raise bad_field(
            path,
            f"covariance ({', '.join(columns)}) of point {names[i]}",
            given,
            "a positive semi-definite matrix",
            row=int(rows[i]) + 1,
        )


def _descriptors(table: pl.DataFrame, rows: NDArray[np.int64], feature: str, path: Path) -> NDArray[Any]:
    kind = np.uint8 if feature == "orb" else np.float32
    if "descriptor" not in table.columns or table["descriptor"].dtype != pl.Binary:
        raise InputError(f"{path}: has no column descriptor of bytes")
    content = table["descriptor"].to_list()
    chosen = [content[i] or b"" for i in rows.tolist()]
    if len({len(row) for row in chosen}) != 1 or not chosen[0] or len(chosen[0]) % np.dtype(kind).itemsize:
        raise InputError(
            f"{path}: descriptors are empty or differ in length, expected one length for feature {feature}"
        )
    values = np.frombuffer(b"".join(chosen), dtype=kind).reshape(len(chosen), -1).copy()
    if len(bad := np.flatnonzero(~(np.abs(values) <= LARGEST_VALUE).all(axis=1))):
        raise bad_field(
            path,
            "descriptor",
            "values out of bounds",
            f"finite numbers up to {LARGEST_VALUE:g}",
            row=int(rows[bad[0]]) + 1,
        )
    return values


def write_ply(points: PointMap, path: Path) -> None:
    """Write a PLY file for viewers of point clouds.

    Each vertex has the position of a point, its standard deviation in the worst direction [m] and its number of views.
    Format: G. Turk, "The PLY polygon file format", 1994.
    """
    sigma = worst_sigma(points.covariances)
    views = np.bincount(points.owners, minlength=len(points))
    rows = zip(points.positions.tolist(), sigma.tolist(), views.tolist(), strict=True)
    body = "".join(f"{x:.6f} {y:.6f} {z:.6f} {s:.6f} {count}\n" for (x, y, z), s, count in rows)
    with writing(path):
        write_text(path, PLY.format(count=len(points)) + body)


@dataclass(frozen=True, eq=False)
class CommonError:
    """The error of a map that neighbouring points share, because the map was made along an estimated trajectory.

    ``places`` (K, 2): positions of the camera when the map was made [m]. ``directions`` (K, 2): mean direction, as a
    unit vector, from each position to the observed points. ``covariances`` (K, 3, 3): covariance [m, rad] of
    (x, y, heading) of the shared error at each position.

    A robot that localizes in the map has the same error, however many points it observes. Estimators therefore add the
    covariance at the nearest position to that of the robot's pose.
    """

    places: Array
    directions: Array
    covariances: Array

    @classmethod
    def of(cls, points: PointMap) -> CommonError | None:
        """Return the shared error of a map. Returns None if the map has none (``points.common`` is None)."""
        if points.common is None or not len(points.owners):
            return None
        places, first, of = np.unique(points.seen_from[:, :2], axis=0, return_index=True, return_inverse=True)
        rays = points.positions[points.owners, :2] - points.seen_from[:, :2]
        directions = np.zeros_like(places)
        np.add.at(directions, of.ravel(), _unit(rays))
        return cls(places, _unit(directions), points.common[first])

    def at(self, poses: Array, looking: float = 0.0) -> Array:
        """Return the covariances (N, 3, 3) [m, rad] of the shared error at the ``poses`` (N, 3) of a robot.

        For each pose, the camera position of the map is selected that is nearest in distance and direction of view. Its
        covariance is transformed to the pose by :func:`carried`. ``looking`` [rad]: the direction of the robot's camera
        in the robot frame.
        """
        ahead = poses[:, 2] + looking
        cosine = np.column_stack((np.cos(ahead), np.sin(ahead))) @ self.directions.T
        away = np.linalg.norm(poses[:, None, :2] - self.places, axis=2)
        nearest = np.hypot(away, ARM * np.arccos(np.clip(cosine, -1.0, 1.0))).argmin(axis=1)
        return carried(self.covariances[nearest], poses[:, :2] - self.places[nearest])


def carried(covariances: Array, arms: Array) -> Array:
    """Return the covariances (N, 3, 3) of (x, y, heading) [m, rad] of N points. Each point is fixed to a rigid body, on
    which another point has a known covariance.

    ``covariances`` (N, 3, 3): of the other point. ``arms`` (N, 2) [m]: the vector from the other point to the point.
    All are in the world frame.
    """
    lever = np.repeat(np.eye(3)[None], len(arms), axis=0)
    lever[:, 0, 2], lever[:, 1, 2] = -arms[:, 1], arms[:, 0]
    return np.asarray(lever @ covariances @ lever.transpose(0, 2, 1))


def without_common(points: PointMap) -> PointMap:
    """Return the map with the covariance of the shared error (:class:`CommonError`) subtracted from that of each point.
    A map without a shared error is returned unchanged."""
    if points.common is None:
        return points
    moved = carried(points.common, points.positions[points.owners, :2] - points.seen_from[:, :2])[:, :2, :2]
    order = np.argsort(-np.trace(moved, axis1=1, axis2=2), kind="stable")
    shared = np.zeros_like(points.covariances)
    shared[points.owners[order], :2, :2] = moved[order]  # if a point has several views, the smallest error remains
    values, axes = np.linalg.eigh(points.covariances - shared)
    own = (axes * np.maximum(values, LEAST**2)[:, None, :]) @ axes.transpose(0, 2, 1)
    return replace(points, covariances=own)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9))

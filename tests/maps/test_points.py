"""Maps of points on disk: what is written comes back, and damaged files are told by a line."""

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusal import refusal

from factorgraph_loc.files.columns import COVARIANCES
from factorgraph_loc.maps.points import PointMap, read_points, write_points


def a_map(count, views, feature="sift", seed=0, *, common=False):
    """A map of ``count`` points of which those in ``views`` are seen, once for each time they stand there; with an error that they
    have in ``common`` or not."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((count, 3, 3))
    bits = feature == "orb"
    descriptors = (
        rng.integers(0, 256, (len(views), 32)).astype(np.uint8)
        if bits
        else rng.standard_normal((len(views), 37)).astype(np.float32)
    )
    return PointMap(
        tuple(f"p{i}" for i in range(count)),
        rng.standard_normal((count, 3)),
        root @ root.transpose(0, 2, 1),
        feature,
        np.array(sorted(views), dtype=np.int64),
        descriptors,
        rng.standard_normal((len(views), 3)),
        root[views] @ root[views].transpose(0, 2, 1) if common else None,
    )


def assert_same(found, points):
    """Equal, covariances to what symmetry rounds."""
    for name in ("names", "feature"):
        assert getattr(found, name) == getattr(points, name)
    for name in ("positions", "owners", "descriptors", "seen_from"):
        np.testing.assert_array_equal(getattr(found, name), getattr(points, name))
    np.testing.assert_allclose(found.covariances, points.covariances, rtol=1e-14)
    assert (found.common is None) == (points.common is None)
    if points.common is not None:
        np.testing.assert_allclose(found.common, points.common, rtol=1e-14)
    assert found.descriptors.dtype == points.descriptors.dtype


@given(
    st.integers(1, 6).flatmap(lambda n: st.tuples(st.just(n), st.lists(st.integers(0, n - 1), min_size=1, max_size=9))),
    st.sampled_from(["sift", "orb", "colour"]),
    st.booleans(),
)
def test_what_is_written_comes_back(tmp_path_factory, counts, feature, common):
    points = a_map(*counts, feature, common=common)
    path = tmp_path_factory.mktemp("maps") / "a.points.parquet"
    write_points(points, path)
    assert_same(read_points(path), points)


def test_a_map_without_what_its_points_have_in_common_is_read(tmp_path):
    path = tmp_path / "a.points.parquet"
    write_points(a_map(3, [0, 1, 1], common=True), path)
    assert [name for name in pl.read_parquet(path).columns if name.startswith("cov_")] == list(COVARIANCES)
    pl.read_parquet(path).drop(COVARIANCES).write_parquet(path)
    assert read_points(path).common is None


def test_points_known_by_name_alone(tmp_path):
    points = PointMap.of(("b", "a"), np.arange(6.0).reshape(2, 3))
    write_points(points, tmp_path / "a.points.parquet")
    found = read_points(tmp_path / "a.points.parquet")
    assert found == points
    assert found.index == {"b": 0, "a": 1}
    assert len(found) == 2


def test_maps_that_differ():
    points = a_map(3, [0, 1, 1])
    assert points == a_map(3, [0, 1, 1])
    assert points != a_map(3, [0, 1, 1], seed=1)
    assert points != "points"


@pytest.fixture
def written(tmp_path):
    """``written(change)``: the path of a map whose table was changed."""

    def write(change):
        path = tmp_path / "a.points.parquet"
        write_points(a_map(3, [0, 1, 1], common=True), path)
        change(pl.read_parquet(path)).write_parquet(path)
        return path

    return write


def in_row(table, row, **cells):
    """The table with other ``cells`` in one row."""
    there = pl.int_range(len(table)) == row
    return table.with_columns(
        pl.when(there).then(pl.lit(v, pl.Float64)).otherwise(pl.col(c)).alias(c) for c, v in cells.items()
    )


def test_a_flat_covariance_is_one(written):
    table = lambda t: t.with_columns(xx=pl.lit(4.0), xy=pl.lit(2.0), yy=pl.lit(1.0), xz=0.0, yz=0.0, zz=0.0)  # noqa: E731
    assert read_points(written(table)).covariances[2].tolist() == [[4.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 0.0]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.with_columns(point=pl.Series(["p0", "p1", None, "p2"])), ":3: point is '', expected the name"),
        (lambda t: in_row(t, 2, x=7.0), ":3: x is 7.0, expected "),
        (lambda t: in_row(t, 2, yz=7.0), " as in row 2 of point p1"),
        (lambda t: in_row(t, 3, xx=0.0, xy=1.0), ":4: covariance (xx, xy, xz, yy, yz, zz) of point p2 is (0.0, 1.0, "),
        (lambda t: t.with_columns(feature=pl.lit("surf")), ":1: feature is 'surf', expected colour or sift or orb"),
    ],
)
def test_damaged_tables(written, change, message):
    path = written(change)
    refusal(lambda: read_points(path), message, str(path))

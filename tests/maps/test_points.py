"""Maps of points on disk: what is written comes back, and damaged files are told by a line."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusal import refusal

from factorgraph_loc.files.columns import COVARIANCES
from factorgraph_loc.maps.points import LEAST, CommonError, PointMap, carried, read_points, without_common, write_points
from factors import se2


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


SIGMAS = (0.1, 0.2, 0.05)  # m, m, rad


def chained_map(places, headings, covariances):
    """A point 2 m ahead of each of ``places`` (K, 2), seen from there with the error that is common there."""
    ahead = np.column_stack((np.cos(headings), np.sin(headings)))
    positions = np.column_stack((places + 2.0 * ahead, np.ones(len(places))))
    own = np.diag((0.03, 0.04, 0.05)) ** 2
    total = np.repeat(own[None], len(places), axis=0)
    total[:, :2, :2] += carried(covariances, 2.0 * ahead)[:, :2, :2]
    return PointMap(
        tuple(f"p{i}" for i in range(len(places))),
        positions,
        total,
        "colour",
        np.arange(len(places)),
        np.zeros((len(places), 4), dtype=np.float32),
        np.column_stack((places, np.full(len(places), 0.9))),
        covariances,
    )


def test_an_error_is_that_of_the_place_from_which_the_same_was_seen():
    scales = np.array((1.0, 4.0, 9.0))
    covariances = scales[:, None, None] * np.diag(np.square(SIGMAS))
    error = CommonError.of(
        chained_map(np.array(((0.0, 0.0), (0.0, 0.0), (5.0, 0.0))), np.array((0.0, 3.0, 0.0)), covariances)
    )
    # two looks from one place are of one keyframe; those of different keyframes do not lie on each other
    assert len(error.places) == 2
    there = np.array(((0.0, 0.0, 0.0), (5.1, 0.0, 0.1), (4.9, 0.0, -6.2)))
    np.testing.assert_allclose(error.at(there)[0], covariances[0])
    np.testing.assert_allclose(error.at(there)[1:, 2, 2], covariances[2, 2, 2])
    turned = chained_map(np.array(((0.0, 0.0), (0.1, 0.0))), np.array((0.0, np.pi)), covariances[:2])
    np.testing.assert_allclose(CommonError.of(turned).at(np.array(((0.0, 0.0, 3.1),)))[0, 2, 2], covariances[1, 2, 2])
    # a camera that looks back
    looking_back = CommonError.of(turned).at(np.array(((0.0, 0.0, 0.0),)), looking=np.pi)
    np.testing.assert_allclose(looking_back[0, 2, 2], covariances[1, 2, 2])


def test_an_error_is_carried_as_by_a_rigid_body():
    rng = np.random.default_rng(0)
    errors = rng.multivariate_normal(np.zeros(3), np.diag(np.square(SIGMAS)) / 100.0, size=20_000)
    place, arm = np.array((1.0, 2.0, 0.0)), np.array((3.0, -1.0))
    moved = se2.compose(se2.compose(place, errors), np.array((*arm, 0.0)))
    found = np.cov((moved - np.append(place[:2] + arm, 0.0)).T)
    expected = carried(np.diag(np.square(SIGMAS))[None] / 100.0, arm[None])[0]
    np.testing.assert_allclose(found, expected, atol=0.03 * np.trace(expected))


def test_points_have_an_error_of_their_own_beside_it():
    points = chained_map(np.zeros((1, 2)), np.array((0.3,)), np.diag(np.square(SIGMAS))[None])
    np.testing.assert_allclose(without_common(points).covariances[0], np.diag((0.03, 0.04, 0.05)) ** 2, atol=1e-12)
    tight = replace(points, covariances=0.5 * points.covariances)
    assert np.linalg.eigvalsh(without_common(tight).covariances).min() == pytest.approx(LEAST**2)


def test_a_map_with_a_reference_has_none():
    points = chained_map(np.zeros((1, 2)), np.zeros(1), np.eye(3)[None])
    assert CommonError.of(replace(points, common=None)) is None
    assert without_common(replace(points, common=None)).covariances is points.covariances
    assert CommonError.of(PointMap.of(("a",), np.zeros((1, 3)))) is None

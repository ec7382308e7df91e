"""Bundles and standalone tags of apriltag_ros as markers of a map."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusal import refusal
from scipy.spatial.transform import Rotation

from factorgraph_loc import read_world

# corners of a tag of side 1 in its frame, with x right, y up and z towards the viewer: from the upper left one, clockwise
CORNERS = np.array([(-0.5, 0.5, 0.0), (0.5, 0.5, 0.0), (0.5, -0.5, 0.0), (-0.5, -0.5, 0.0)])
TAGS = """\
standalone_tags:
  [
    {id: 3, size: 0.1, name: DOCK},
    {id: 4, size: 0.2},
  ]
tag_bundles:
  [
    { name: 'board', layout: [ {id: 7, size: 0.16}, {id: 8, size: 0.16, x: 0.5, y: -0.1, qw: 1.0, qx: 0.0} ] },
  ]
"""


def world_of(folder, tags, markers=""):
    (folder / "tags.yaml").write_text(tags)
    (folder / "w.world.toml").write_text(f'[markers]\nfile = "tags.yaml"\nfamily = "tag36h11"\n{markers}')
    return folder / "w.world.toml"


def corners_of(world, marker):
    names = list(world.points.names)
    return np.array([world.points.positions[names.index(f"{marker}/{i}")] for i in range(4)])


def test_a_bundle_in_the_frame_of_the_map(tmp_path):
    world = read_world(world_of(tmp_path, TAGS))
    np.testing.assert_allclose(corners_of(world, "tag36h11-7"), 0.16 * CORNERS, atol=1e-12)
    np.testing.assert_allclose(corners_of(world, "tag36h11-8"), 0.16 * CORNERS + (0.5, -0.1, 0.0), atol=1e-12)
    assert len(world.points.names) == 8


def test_bundles_and_tags_on_walls(tmp_path):
    """A board on a wall that looks along y, and a tag that looks along x."""
    places = "[markers.at.board]\nx = 1.0\ny = 2.0\nz = 1.5\nfacing = 1.5707963267948966\n[markers.at.3]\nz = 1.0\n"
    world = read_world(world_of(tmp_path, TAGS, f"sigma = 0.01\n{places}"))
    upper_left = (1.0 + 0.08, 2.0, 1.58)  # somebody who looks along -y has x on the left
    np.testing.assert_allclose(corners_of(world, "tag36h11-7")[0], upper_left, atol=1e-12)
    np.testing.assert_allclose(corners_of(world, "tag36h11-8").mean(axis=0), (0.5, 2.0, 1.4), atol=1e-12)
    np.testing.assert_allclose(corners_of(world, "tag36h11-3")[0], (0.0, -0.05, 1.05), atol=1e-12)
    np.testing.assert_allclose(world.points.covariances[0], 1e-4 * np.eye(3))


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(seed=st.integers(0, 10_000), is_on_ceiling=st.booleans())
def test_corners_are_where_the_bundle_has_them(tmp_path, seed, is_on_ceiling):
    rng = np.random.default_rng(seed)
    turn = Rotation.from_euler("X", np.pi) if is_on_ceiling else Rotation.random(rng=rng)
    place = rng.uniform(-5.0, 5.0, 3)
    q = dict(zip(("qx", "qy", "qz", "qw"), turn.as_quat().tolist(), strict=True))
    tag = {"id": 5, "size": 0.3, **dict(zip("xyz", place.tolist(), strict=True)), **q}
    world = read_world(world_of(tmp_path, json.dumps({"tag_bundles": [{"layout": [tag]}]})))
    np.testing.assert_allclose(corners_of(world, "tag36h11-5"), place + turn.apply(0.3 * CORNERS), atol=1e-6)


TWO = TAGS.replace("  ]\n", "    { layout: [ {id: 9, size: 0.1} ] },\n  ]\n").replace(
    "    { layout: [ {id: 9, size: 0.1} ] },\n  ]\ntag", "  ]\ntag"
)


@pytest.mark.parametrize(
    ("tags", "markers", "words"),
    [
        (TWO, "", ("tags.yaml has several bundles without a pose: give [markers.at.bundle_1]",)),
        (TAGS, "[markers.at.bord]\n", ("at.bord is not in tags.yaml, expected one of board, 3, 4",)),
        (TAGS.replace("id: 8", "id: 7"), "", ("tags.yaml: id is 7, expected each tag in one place",)),
        (TAGS.replace("qx: 0.0", "qx: 1.0"), "", ("tag 8: qx, qy, qz, qw is [1.0, 0.0, 0.0, 1.0], expected a unit",)),
        (
            TAGS.replace("size: 0.2", "size: 200"),
            "",
            ("tags.yaml: standalone_tags.1.size is 200", "less than or equal to 10"),
        ),
        (
            TAGS.partition("tag_b")[0],
            "",
            ("has no poses of tags: add", "such as [markers.at.3]"),
        ),
        ("a: 1\n", "", ("has neither standalone_tags nor tag_bundles",)),
        (TAGS, "size = 2\n", ("size",)),
    ],
)
def test_what_is_refused(tmp_path, tags, markers, words):
    refusal(lambda: read_world(world_of(tmp_path, tags, markers)), *words)


def test_two_bundles_with_their_places(tmp_path):
    world = read_world(world_of(tmp_path, TWO, "[markers.at.bundle_1]\nx = 3.0\n"))
    np.testing.assert_allclose(corners_of(world, "tag36h11-9").mean(axis=0), (3.0, 0.0, 0.0), atol=1e-12)

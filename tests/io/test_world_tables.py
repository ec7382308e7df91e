"""Tags of other programs' tables and fiducial markers in a world's file."""

import numpy as np
import pytest

from factorgraph_loc import InputError, PointMap, Tag, read_world, write_world
from factorgraph_loc.maps.markers import Marker
from factorgraph_loc.maps.points import write_points

SHEET = "Tag ID;Ort;X [cm];Y [cm];Höhe [cm];Richtung\ne2001;Regal;100,5;-20;120;90\nE2002;Tor;0;3;;\n"
TAGS = """\
[tags]
file = "sheet.csv"
separator = ";"
decimal = ","
epc_case = "upper"
columns = { epc = "Tag ID", x = "X [cm]", y = "Y [cm]", z = "Höhe [cm]", facing = "Richtung" }
units = { x = "cm", y = "cm", z = "cm", facing = "deg" }
"""


@pytest.fixture
def world(tmp_path):
    """Writes a world's file, beside a spreadsheet of tags, and reads it."""
    (tmp_path / "sheet.csv").write_text(SHEET)

    def call(text):
        (tmp_path / "a.world.toml").write_text(text)
        return read_world(tmp_path / "a.world.toml")

    return call


def test_tags_of_a_spreadsheet(world):
    tags = world(TAGS).tags
    assert list(tags) == ["E2001", "E2002"]
    np.testing.assert_allclose((tags["E2001"].x, tags["E2001"].y, tags["E2001"].z), (1.005, -0.2, 1.2))
    np.testing.assert_allclose(tags["E2001"].facing, np.pi / 2)
    assert tags["E2002"] == Tag(x=0.0, y=0.03)


def test_corners_as_they_are_seen_from_the_front():
    """A marker at the end of a corridor, seen by who walks along x: its left is at +y."""
    corners = Marker(x=4.0, y=1.0, z=1.5, size=0.2, facing=np.pi).corners()
    np.testing.assert_allclose(corners, ((4, 1.1, 1.6), (4, 0.9, 1.6), (4, 0.9, 1.4), (4, 1.1, 1.4)), atol=1e-12)
    turned = Marker(x=4.0, y=1.0, z=1.5, size=0.2, facing=np.pi, roll=np.pi / 2).corners()
    np.testing.assert_allclose(turned, np.roll(corners, 1, axis=0), atol=1e-12)


def test_markers_are_points_beside_others(world, tmp_path):
    write_points(PointMap.of(["seen"], np.array(((1.0, 2.0, 3.0),))), tmp_path / "a.points.parquet")
    markers = '[markers]\n"tag36h11-7" = { x = 4.0, y = 1.0, z = 1.5, size = 0.2, facing = 3.14159, sigma = 0.01 }\n'
    points = world('points = "a.points.parquet"\n' + markers).points
    assert points.names == ("seen", "tag36h11-7/0", "tag36h11-7/1", "tag36h11-7/2", "tag36h11-7/3")
    np.testing.assert_allclose(points.covariances[1], 1e-4 * np.eye(3))
    written = world(markers)
    write_world(written, tmp_path / "b.world.toml")
    assert read_world(tmp_path / "b.world.toml") == written


def test_a_marker_must_not_have_the_name_of_another_point(world, tmp_path):
    write_points(PointMap.of(["m/2"], np.zeros((1, 3))), tmp_path / "a.points.parquet")
    with pytest.raises(InputError, match="m/2 occurs twice"):
        world('points = "a.points.parquet"\n[markers]\nm = { x = 0, y = 0, z = 0, size = 1, facing = 0 }\n')

"""Occupancy maps of ROS's map_server become walls."""

import tracemalloc

import numpy as np
import pytest
from PIL import Image
from refusal import refusal

from factorgraph_loc import InputError, read_world
from factorgraph_loc.maps.occupancy import read_walls

YAML = """\
image: hall.pgm
resolution: 0.1
origin: [-1.0, -2.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def room(width=40, height=30, thick=1):
    """A free room with walls at its border, unknown outside: cells as map_saver writes them."""
    cells = np.full((height, width), 205, dtype=np.uint8)
    cells[4:-4, 4:-4] = 0
    cells[4 + thick : -4 - thick, 4 + thick : -4 - thick] = 254
    return cells


@pytest.fixture
def hall(tmp_path):
    Image.fromarray(room()).save(tmp_path / "hall.pgm")
    (tmp_path / "hall.yaml").write_text(YAML)
    return tmp_path / "hall.yaml"


def ends(walls):
    return {tuple(np.round(sorted(((a, b), (c, d))), 6).ravel().tolist()) for a, b, c, d in walls}


# the middles of the outermost cells: columns 4 and 35, rows 4 and 25 from above, of which there are 30
LEFT, RIGHT, LOW, HIGH = -1.0 + 0.45, -1.0 + 3.55, -2.0 + 0.45, -2.0 + 2.55
ROOM = {
    (LEFT, LOW, RIGHT, LOW),
    (LEFT, HIGH, RIGHT, HIGH),
    (LEFT, LOW, LEFT, HIGH),
    (RIGHT, LOW, RIGHT, HIGH),
}


def test_a_room_has_four_walls_at_their_places(hall):
    found = np.array(sorted(ends(read_walls(hall))))
    outer = found[np.max(np.abs(found[:, 0:2] - found[:, 2:4]), axis=1) > 1.0]
    for wall in ROOM:
        assert np.min(np.max(np.abs(outer - wall), axis=1)) < 1e-6
    # the inner outline of a wall of one cell runs within a cell of the outer one, and nothing is in the room
    inside = (found[:, 0] > LEFT + 0.15) & (found[:, 0] < RIGHT - 0.15)
    inside &= (found[:, 1] > LOW + 0.15) & (found[:, 1] < HIGH - 0.15)
    assert not inside.any()


def test_a_turned_origin_turns_the_walls(hall):
    straight = np.array(read_walls(hall))
    hall.write_text(YAML.replace("[-1.0, -2.0, 0.0]", "[-1.0, -2.0, 1.5707963267948966]"))
    turned = np.array(read_walls(hall))
    np.testing.assert_allclose(turned[:, 0] + 1.0, -(straight[:, 1] + 2.0), atol=1e-5)
    np.testing.assert_allclose(turned[:, 1] + 2.0, straight[:, 0] + 1.0, atol=1e-5)


def test_an_aslant_wall_is_one_line_not_a_staircase(hall):
    cells = np.full((60, 60), 254, dtype=np.uint8)
    for i in range(50):
        cells[5 + i // 2 : 7 + i // 2, 5 + i] = 0
    Image.fromarray(cells).save(hall.parent / "hall.pgm")
    walls = np.array(read_walls(hall))
    assert len(walls) <= 6
    assert np.hypot(walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]).max() > 4.5


@pytest.mark.parametrize(("negate", "alpha"), [(1, False), (0, True)])
def test_other_ways_to_write_a_map(hall, negate, alpha):
    expected = read_walls(hall)
    cells = room()
    if alpha:
        opaque = np.where(cells == 205, 0, 255).astype(np.uint8)
        Image.fromarray(np.dstack((np.where(cells == 205, 0, cells).astype(np.uint8), opaque)), "LA").save(
            hall.parent / "hall.png"
        )
    else:
        Image.fromarray(255 - cells).save(hall.parent / "hall.png")
    hall.write_text(YAML.replace("hall.pgm", "/somewhere/else/hall.png").replace("negate: 0", f"negate: {negate}"))
    assert read_walls(hall) == expected


def test_an_origin_as_map_saver_of_ros_2_writes_it(hall):
    expected = read_walls(hall)
    block = "origin:\n- -1\n- -2\n- 0\n"
    hall.write_text("# a map\n" + YAML.replace("origin: [-1.0, -2.0, 0.0]\n", block) + "mode: trinary\n")
    assert read_walls(hall) == expected


def test_specks_are_no_walls(hall):
    expected = read_walls(hall)
    cells = room()
    cells[15, 15] = cells[20, 20] = cells[20, 21] = 0
    Image.fromarray(cells).save(hall.parent / "hall.pgm")
    assert read_walls(hall) == expected


def test_a_world_names_its_occupancy_map(hall):
    (hall.parent / "hall.world.toml").write_text('name = "hall"\nwalls = "hall.yaml"\n')
    assert read_world(hall.parent / "hall.world.toml").walls == read_walls(hall)


@pytest.mark.parametrize(
    ("old", "new", "fragments"),
    [
        ("resolution: 0.1", "", ("hall.yaml: resolution is missing",)),
        ("0.0]", "", ("hall.yaml:3: is not YAML that can be read: while parsing a flow sequence",)),
        ("free_thresh: 0.196", "free_thresh: 0.7", ("free_thresh is 0.7", "less than occupied_thresh")),
        ("hall.pgm", "hall.yaml", ("hall.yaml: is not an image",)),
        ("negate: 0", "negate: 1\nmode: trinary", None),
    ],
)
def test_a_wrong_map(hall, old, new, fragments):
    hall.write_text(YAML.replace(old, new))
    if fragments is None:  # free space and unknown are occupied where the greys are the other way round: no error
        assert read_walls(hall)
        return
    refusal(lambda: read_walls(hall), *fragments)


def test_a_map_without_walls(hall):
    Image.fromarray(np.full((9, 9), 254, dtype=np.uint8)).save(hall.parent / "hall.pgm")
    with pytest.raises(InputError, match="no occupied cells"):
        read_walls(hall)


def test_a_large_map_needs_few_bytes_per_cell(tmp_path):
    """Less than 8 bytes of arrays per cell; floating-point numbers of all cells need more."""
    cells = np.zeros((2000, 3000), dtype=np.uint8)
    Image.fromarray(cells).save(tmp_path / "hall.png")
    (tmp_path / "hall.yaml").write_text(YAML.replace("hall.pgm", "hall.png"))
    tracemalloc.start()
    try:
        assert len(read_walls(tmp_path / "hall.yaml")) == 4
        assert tracemalloc.get_traced_memory()[1] < 8 * cells.size
    finally:
        tracemalloc.stop()

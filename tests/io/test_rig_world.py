"""What people write in TOML: rigs and worlds, and the messages when something is wrong in them."""

import re
from pathlib import Path

import pytest
from refusal import refusal

from factorgraph_loc import Rig, Tag, World, read_rig, read_world, write_world


def test_a_rig_needs_nothing_but_what_it_has(tmp_path):
    (tmp_path / "a.rig.toml").write_text("")
    assert read_rig(tmp_path / "a.rig.toml") == Rig()
    assert Rig().time_offset("bearing_range") == 0.0


def test_a_strong_wide_lens_is_a_camera():
    lens = {"fx": 300.0, "fy": 300.0, "cx": 320.0, "cy": 240.0, "distortion": (-0.3, 0.09, 0.0, 0.0)}
    assert Rig.model_validate({"camera": lens}).camera.model().distortion == lens["distortion"]


def test_the_example_of_the_documentation(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "rig.md").read_text()
    (example,) = (found for found in re.findall(r"```toml\n(.*?)```", page, re.DOTALL) if "[rfid]" in found)
    (tmp_path / "a.rig.toml").write_text(example)
    model = read_rig(tmp_path / "a.rig.toml").rfid.model()
    assert [antenna.model for antenna in model.antennas] == [0, 1]


BAD_RIGS = {
    "missing": ("[bearing_range]\nbearing_sigma = 0.1\n", "bearing_range.range_sigma is missing"),
    "misspelt": (
        "[odometry]\nscale_distanse = 1\n",
        "unknown key odometry.scale_distanse: did you mean scale_distance?",
    ),
    "folded lens": (
        "[camera]\nfx = 500\nfy = 500\ncx = 320\ncy = 240\ndistortion = [-0.3, 0, 0, 0]\n",
        "the distortion (-0.3, 0.0, 0.0, 0.0) cannot be inverted at the pixel (-0.5, -0.5), expected coefficients",
    ),
}


@pytest.mark.parametrize(("text", "fragment"), BAD_RIGS.values(), ids=list(BAD_RIGS))
def test_bad_rigs(tmp_path, text, fragment):
    file = tmp_path / "a.rig.toml"
    file.write_text(text)
    refusal(lambda: read_rig(file), f"{file}: ", fragment)


BAD_WORLDS = {
    "misspelt": ("[landmarks.A]\nx = 1\ny = 2\nsigm = 3\n", "unknown key landmarks.A.sigm: did you mean sigma?"),
    "tag's covariance": ("[tags.E1]\nx = 1\ny = 2\ncovariance = [1, 2, 1]\n", "positive semi-definite"),
    "table outside": ('tags = "../a.tags.csv"\n', "leaves its folder"),
}


@pytest.mark.parametrize(("text", "fragment"), BAD_WORLDS.values(), ids=list(BAD_WORLDS))
def test_bad_worlds(tmp_path, text, fragment):
    (tmp_path / "a.world.toml").write_text(text)
    refusal(lambda: read_world(tmp_path / "a.world.toml"), "a.world.toml: ", fragment)


def test_tags_and_walls_come_back(tmp_path):
    tags = {"E1": Tag(x=1.0, y=1 / 3, z=0.5, facing=-1.5), 'a "comma", ü': Tag(x=0.1, y=0.2, sigma=0.05)}
    world = World(name="hall", tags=tags, walls=((0.0, 1.0, 2.0, 3.0), (2.0, 3.0, -4.0, 5.5)))
    write_world(world, tmp_path / "a.world.toml")
    assert "E1" not in (tmp_path / "a.world.toml").read_text()
    assert (tmp_path / "a.tags.csv").read_text().splitlines()[:2] == [
        "epc,x,y,z,facing,sigma",
        "E1,1.0,0.3333333333333333,0.5,-1.5,0.0",
    ]
    assert read_world(tmp_path / "a.world.toml") == world


def test_tags_with_covariances_stay_in_the_map(tmp_path):
    world = World(tags={"E1": Tag(x=1.0, y=2.0, covariance=(0.04, 0.01, 0.09))})
    write_world(world, tmp_path / "a.world.toml")
    assert [file.name for file in tmp_path.iterdir()] == ["a.world.toml"]
    assert read_world(tmp_path / "a.world.toml") == world


def test_a_table_of_tags_by_hand(tmp_path):
    (tmp_path / "a.world.toml").write_text('tags = "a.tags.csv"\n')
    (tmp_path / "a.tags.csv").write_text("y,x,epc,z,facing,label\n2,1,E1,,,shelf\n\n4,3,E2,0.5,3.14,\n")
    world = read_world(tmp_path / "a.world.toml")
    assert world.tags == {"E1": Tag(x=1, y=2), "E2": Tag(x=3, y=4, z=0.5, facing=3.14)}


BAD_TAGS = {
    "twice": ("E1,1,2,3,\nE2,1,2,3,\nE1,4,5,6,\n", ":4: epc is 'E1', expected another name than in row 2"),
    "no EPC": (",1,2,3,\n", ":2: epc is ''"),
}


@pytest.mark.parametrize(("rows", "fragment"), BAD_TAGS.values(), ids=list(BAD_TAGS))
def test_bad_tables_of_tags(tmp_path, rows, fragment):
    (tmp_path / "a.world.toml").write_text('tags = "a.tags.csv"\n')
    (tmp_path / "a.tags.csv").write_text("epc,x,y,z,facing\n" + rows)
    refusal(lambda: read_world(tmp_path / "a.world.toml"), "a.tags.csv:", fragment)

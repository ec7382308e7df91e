"""What people write in TOML: rigs and worlds, and the messages when something is wrong in them."""

import numpy as np
import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.rig import BearingRangeSettings, ImuSettings, OdometrySettings, Rig, read_rig, write_rig
from factorgraph_loc.world import Landmark, World, read_world, write_world

GOOD = "[bearing_range]\nrange_sigma = 0.1\n"


def test_a_rig_comes_back(tmp_path):
    rig = Rig(
        name="cart",
        sensors=("odometry", "imu"),
        odometry=OdometrySettings(lag=0.15, direction=-0.08),
        imu=ImuSettings(bias=0.01),
        bearing_range=BearingRangeSettings(range_sigma=0.1, x=0.2),
    )
    write_rig(rig, tmp_path / "a.rig.toml")
    assert read_rig(tmp_path / "a.rig.toml") == rig


def test_a_world_comes_back(tmp_path):
    world = World(name="hall", landmarks={"A 1": Landmark(x=1.0, y=-2.5, sigma=0.01), "ü": Landmark(x=0.1, y=0.2)})
    write_world(world, tmp_path / "a.world.toml")
    assert read_world(tmp_path / "a.world.toml") == world


def test_a_rig_needs_nothing_but_what_it_has(tmp_path):
    (tmp_path / "a.rig.toml").write_text("")
    assert read_rig(tmp_path / "a.rig.toml") == Rig()
    assert Rig().time_offset("bearing_range") == 0.0


def test_positions():
    world = World(landmarks={"A": Landmark(x=1, y=2), "B": Landmark(x=3, y=4)})
    np.testing.assert_array_equal(world.positions(), ((1, 2), (3, 4)))
    np.testing.assert_array_equal(world.position("B"), (3, 4))
    assert world.position("C") is None
    assert World().positions().shape == (0, 2)


BAD_RIGS = {
    "degrees": (
        GOOD + "bearing_sigma = 5\n",
        "bearing_range.bearing_sigma is 5: input should be less than or equal to 0.5",
    ),
    "direction in degrees": ("[odometry]\ndirection = 90\n", "odometry.direction is 90"),
    "millimetres": (GOOD + "x = 203\n", "bearing_range.x is 203"),
    "no noise": ("[bearing_range]\nrange_sigma = 0\n", "range_sigma is 0"),
    "missing": ("[bearing_range]\nbearing_sigma = 0.1\n", "bearing_range.range_sigma is missing"),
    "misspelt": (
        "[odometry]\nscale_distanse = 1\n",
        "unknown key odometry.scale_distanse: did you mean scale_distance?",
    ),
    "misspelt deep": ("[odometry.noise.along]\nper_meter = 1\n", "unknown key odometry.noise.along.per_meter"),
    "misspelt and so missing": ("[bearing_range]\nrange_sigm = 1\n", "did you mean range_sigma? (and 1 more)"),
    "word": ('[odometry]\nlag = "long"\n', "odometry.lag is 'long'"),
    "nan": ("[odometry]\nlag = nan\n", "odometry.lag is nan"),
    "not TOML": ("[odometry\n", "is not TOML"),
}


@pytest.mark.parametrize(("text", "fragment"), BAD_RIGS.values(), ids=list(BAD_RIGS))
def test_bad_rigs(tmp_path, text, fragment):
    file = tmp_path / "a.rig.toml"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        read_rig(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert fragment in str(caught.value)
    assert "\n" not in str(caught.value)


BAD_WORLDS = {
    "no y": ("[landmarks.A]\nx = 1\n", "landmarks.A.y is missing"),
    "misspelt": ("[landmarks.A]\nx = 1\ny = 2\nsigm = 3\n", "unknown key landmarks.A.sigm: did you mean sigma?"),
    "infinite": ("[landmarks.A]\nx = inf\ny = 2\n", "landmarks.A.x is inf"),
    "negative deviation": ("[landmarks.A]\nx = 1\ny = 2\nsigma = -1\n", "landmarks.A.sigma is -1"),
}


@pytest.mark.parametrize(("text", "fragment"), BAD_WORLDS.values(), ids=list(BAD_WORLDS))
def test_bad_worlds(tmp_path, text, fragment):
    (tmp_path / "a.world.toml").write_text(text)
    with pytest.raises(InputError, match=r"a\.world\.toml: ") as caught:
        read_world(tmp_path / "a.world.toml")
    assert fragment in str(caught.value)


def test_missing_files(tmp_path):
    with pytest.raises(InputError, match=r"none.rig.toml: cannot be read: No such file"):
        read_rig(tmp_path / "none.rig.toml")

"""Columns of wheels in mapped tables: their ways, speeds and turns, and what the rig tells of their size."""

import numpy as np
import pytest
from mapped_hall import write_mapped

import factorgraph_loc as fgloc
from factors import se2

ROWS = [(0.0, 0.0, 0.0), (1.0, 2.0, 4.0), (2.0, 4.0, 8.0)]


@pytest.fixture
def table(tmp_path):
    """``table(columns, more)``: a manifest of a table with a time and two numbers of wheels."""

    def make(column, more=""):
        lines = [f"{t},{a},{b}" for t, a, b in ROWS]
        columns = f'columns = {{ t = "t", left{column} = "a", right{column} = "b" }}\nunits = {{ t = "s" }}\n'
        options = f'[options.odometry]\nfile = "wheels.csv"\n{columns}{more}\n'
        return write_mapped(tmp_path, options, wheels="\n".join(["t,a,b", *lines, ""]))

    return make


@pytest.mark.parametrize(("column", "size"), [("_speed", 1.0), ("_rate", 0.1)])
def test_speeds(table, column, size):
    moved = fgloc.read_log(table(column, "track = 0.5" + ("\nradius = 0.1" if column == "_rate" else ""))).streams[
        "odometry"
    ]
    assert moved.v.tolist() == pytest.approx([size * 0.0, size * 3.0, size * 6.0])
    assert moved.w.tolist() == pytest.approx([size * 0.0, size * 4.0, size * 8.0])


def test_turns_and_ways_are_alike(table):
    turned = fgloc.read_log(table("_angle", "track = 0.5\nradius = 0.1"))
    scaled = table("", "track = 5.0")
    ways = fgloc.read_log(scaled).streams["odometry"]
    assert turned.streams["odometry"].dtheta == pytest.approx([0.0, 0.4, 0.4])
    assert np.hypot(ways.dx, ways.dy) == pytest.approx(10.0 * np.hypot(*_places(turned)))
    assert turned.rig.odometry.wheels.model_dump() == {"radius": 0.1, "track": 0.5}


def _places(log):
    moved = log.streams["odometry"]
    return moved.dx, moved.dy


def test_the_rig_comes_first(table):
    rig = fgloc.Rig(odometry={"wheels": {"radius": 0.2, "track": 1.0}})
    for more in ("", "track = 0.5\nradius = 0.1"):
        moved = fgloc.read_log(table("_rate", more), rig=rig).streams["odometry"]
        assert moved.v.tolist() == pytest.approx([0.0, 0.6, 1.2])
        assert moved.w.tolist() == pytest.approx([0.0, 0.4, 0.8])
    ways = fgloc.read_log(table("_speed"), rig=rig).streams["odometry"]
    assert ways.v.tolist() == pytest.approx([0.0, 3.0, 6.0])


# ahead, to the left [m/s] and turning [rad/s]; and the speeds of mecanum wheels at +-.2 m along and +-.15 m across the robot
AHEAD, ASIDE, TURN = 0.3, -0.2, 0.5
MECANUM = [AHEAD + left * (ASIDE + 0.35 * TURN * turned) for left, turned in ((-1, 1), (1, 1), (1, -1), (-1, -1))]


@pytest.mark.parametrize("kind", ["", "_speed"])
@pytest.mark.parametrize("base", ["base = 0.4\n", ""])
def test_four_wheels(tmp_path, kind, base):
    """Mecanum wheels move aside; without ``base`` the wheels of a side are averaged, with a warning that they differ."""
    rows = [np.array((t, *(np.array(MECANUM) * (1.0 if kind else t)))) for t in (0.0, 0.5, 1.0)]
    names = [f"{where}{side}{kind}" for where in ("", "rear_") for side in ("left", "right")]
    columns = "".join(f', {name} = "{column}"' for name, column in zip(names, "abcd", strict=True))
    columns = f'columns = {{ t = "t"{columns} }}\nunits = {{ t = "s" }}\n'
    options = f'[options.odometry]\nfile = "wheels.csv"\ntrack = 0.3\n{base}{columns}'
    wheels = "\n".join(["t,a,b,c,d", *(",".join(map(str, row.tolist())) for row in rows), ""])
    log = fgloc.read_log(write_mapped(tmp_path, options, wheels=wheels))
    moved = log.streams["odometry"]
    assert any("base" in str(warning) for warning in log.warnings) == (not base)
    if base:
        expected = se2.exp(0.5 * np.array((AHEAD, ASIDE, TURN)))
        np.testing.assert_allclose(np.column_stack((moved.dx, moved.dy, moved.dtheta))[1:], [expected] * 2, atol=1e-12)
    elif kind:
        np.testing.assert_allclose(moved.v, AHEAD)
        np.testing.assert_allclose(moved.w, TURN * 0.7 / 0.3)

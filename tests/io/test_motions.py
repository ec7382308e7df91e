"""Odometry that begins anew, encoders that count on from 0, and the units of headings."""

import numpy as np
import pytest
from mapped_hall import write_mapped

from factorgraph_loc.errors import InputError
from factorgraph_loc.io.motions import between_poses, wheel_motions
from factors import se2

STEP = np.array((0.05, 0.0, 0.02))  # in 0.1 s


def stamps(count):
    return np.arange(count, dtype=np.int64) * 100_000_000 + 5


def driven(count, anew=()):
    """Poses of a steady arc; at the rows ``anew`` the odometry is set to the origin."""
    poses = np.zeros((count, 3))
    for i in range(1, count):
        poses[i] = 0.0 if i in anew else se2.compose(poses[i - 1], STEP)
    return poses


@pytest.mark.parametrize("anew", [(), (60,), (40, 90)])
def test_odometry_that_begins_anew_goes_on_as_before(anew):
    warnings = []
    moves = between_poses("odom.csv", stamps(120), driven(120, anew), warnings)
    np.testing.assert_allclose(moves, np.tile(STEP, (119, 1)), atol=1e-9)
    assert len(warnings) == (1 if anew else 0)
    if anew:
        assert warnings[0].fields["t"] == pytest.approx(anew[0] / 10)


def test_a_pause_before_the_new_beginning_is_no_motion_of_a_second_or_more():
    t_ns = stamps(120)
    t_ns[60:] += 20_000_000_000
    moves = between_poses("odom.csv", t_ns, driven(120, (60,)), [])
    np.testing.assert_allclose(moves[59], se2.exp(10.0 * se2.log(STEP)), atol=1e-9)


@pytest.mark.parametrize(("size", "least"), [(2**16, 0), (2**16, -(2**15)), (2**8, 0), (2**32, 0)])
@pytest.mark.parametrize("way", [1, -1])
def test_an_encoder_counts_on_from_its_other_end(size, least, way):
    scale = 0.0002
    ticks = (size // 2 + way * np.array(((30, 35),)) * np.arange(size // 40 if size < 2**20 else 400)[:, None]) % size
    if size > 2**20:
        ticks = (way * np.array(((30, 35),)) * np.arange(-200, 200)[:, None]) % size
    ticks = (ticks - least) % size + least
    warnings = []
    steps = wheel_motions("wheels.csv", stamps(len(ticks)), ticks * scale, np.full(2, scale), warnings)
    np.testing.assert_allclose(steps, np.tile(way * np.array((30, 35)) * scale, (len(ticks) - 1, 1)), atol=1e-6)
    assert warnings == []


def test_encoders_that_are_set_to_0_go_on_as_before():
    ways = np.cumsum(np.full((100, 2), 0.05), axis=0) + 3.0
    ways[70:] -= ways[70]
    warnings = []
    steps = wheel_motions("wheels.csv", stamps(100), ways, np.ones(2), warnings)
    np.testing.assert_allclose(steps, 0.05, atol=1e-9)
    assert len(warnings) == 1


@pytest.fixture
def hall(tmp_path, one):
    def read(columns, rows):
        options = f'[options.odometry]\nfile = "wheels.csv"\n{columns}'
        return one(write_mapped(tmp_path, options, wheels="\n".join([*rows, ""])))

    return read


def test_ticks_of_encoders_are_ways_by_their_unit(hall):
    options = 'columns = { t = "t", left = "l", right = "r" }\nunits = { t = "s", left = 0.001, right = 0.001 }\ntrack = 0.5\n'
    log = hall(options, ["t,l,r", "0,65500,100", "1,65534,136", "2,32,172"])
    np.testing.assert_allclose(log.streams["odometry"].dx, (0.0, 0.035, 0.035), atol=1e-4)


def test_headings_in_degrees_are_refused_unless_the_unit_says_so(hall):
    columns = 'columns = { t = "t", x = "x", y = "y", heading = "h" }\nunits = { t = "s"UNIT }\n'
    rows = ["t,x,y,h", "0,0,0,350", "1,0.1,0,359", "2,0.2,0,8"]
    with pytest.raises(InputError, match=r'wheels.csv:4: heading is 8.0, expected radians.*units.heading = "deg"'):
        hall(columns.replace("UNIT", ""), rows)
    log = hall(columns.replace("UNIT", ', heading = "deg"'), rows)
    np.testing.assert_allclose(log.streams["odometry"].dtheta, np.deg2rad((0.0, 9.0, 9.0)), atol=1e-9)

"""What policies choose."""

import math
from dataclasses import replace

import numpy as np
import pytest

from factorgraph_loc import Rig, World
from factorgraph_loc.maps.free_space import free_space
from factorgraph_loc.model.belief import Mode
from factorgraph_loc.planning.paths import primitives, waypoint_paths
from factorgraph_loc.planning.policies import Situation, policy, usable
from factorgraph_loc.planning.sensors import Sensors
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.sensors.motion import odometry_model
from factorgraph_loc.sensors.rfid.forecast import RfidForecast
from factorgraph_loc.sensors.rfid.settings import RfidSettings
from factorgraph_loc.simulation.settings import RACKHAM_RIG
from factors.rfid.detection import RfidLikelihood, TagArray

SIDE = 40.0
SPACE = free_space(
    World(walls=((0, 0, SIDE, 0), (SIDE, 0, SIDE, SIDE), (SIDE, SIDE, 0, SIDE), (0, SIDE, 0, 0))), clearance=0.3
)
RIG = Rig(**RACKHAM_RIG)
MODEL = RfidSettings(preset="rackham", preset_z=1.2).model()
# the robot is in the middle and looks along x; tags around a place to its left alone
TAGS = np.array(((20.0, 27.0, 1.2), (18.0, 28.0, 1.2), (22.0, 28.0, 1.2)))


def situation(candidates=None, free=None, tags=TAGS, seed=0):
    rng = np.random.default_rng(seed)
    particles = np.array((20.0, 20.0, 0.0)) + rng.standard_normal((500, 3)) * (0.8, 0.8, 0.1)
    paths = tuple(primitives(6.0) if candidates is None else candidates)
    reads = RfidForecast(RfidLikelihood(MODEL, TagArray(tags, np.full(len(tags), np.nan))))
    sensors = Sensors(odometry_model(RIG, constants_as_noise=True), (reads,) if len(tags) else ())
    reach = np.full(len(paths), 3.0) if free is None else free
    return Situation(particles, np.full(500, 1.0 / 500), sensors, SPACE, paths, reach, ActiveSettings(), rng)


def direction(choice):
    return math.atan2(*choice.path.poses[-1, 1::-1])


@pytest.mark.parametrize("name", ["information", "nearest_tags"])
def test_they_go_where_tags_are(name):
    choice = policy(name)(situation())
    assert abs(direction(choice) - math.pi / 2.0) < 0.8
    assert len(choice.values) == len(primitives(6.0))


def test_the_literal_sign_goes_elsewhere():
    here, there = policy("information")(situation()), policy("paper_literal")(situation())
    assert abs(direction(here) - direction(there)) > 0.8
    assert math.sin(direction(there)) < 0.5


def test_what_a_way_costs_counts():
    """In nats per metre; at a price above all that can be learnt no way is worth it, and the robot patrols."""

    def choice(per_metre):
        s = situation()
        costs = s.settings.policy.model_copy(update={"per_metre": per_metre})
        dear = replace(s, settings=s.settings.model_copy(update={"policy": costs}))
        return policy("information")(dear)

    lengths = np.array([p.length for p in situation().candidates])
    assert np.allclose(choice(0.1).values, choice(0.0).values - 0.1 * lengths)
    assert choice(50.0).path.kind == "patrol"


def test_patrol_goes_straight_on_and_then_where_it_is_freest():
    paths = primitives(6.0)
    assert direction(policy("patrol")(situation(paths))) == pytest.approx(0.0)
    left = np.array([3.0 if p.poses[-1, 1] > 0.5 * p.length else 0.5 for p in paths])
    kept, free = usable(paths, left, 3.0)
    choice = policy("patrol")(situation(kept, free))
    assert 0.4 < direction(choice) < 2.8
    # back only where nothing else is
    back = [i for i, p in enumerate(paths) if abs(math.atan2(p.poses[-1, 1], p.poses[-1, 0])) > 3.1]
    only = policy("patrol")(situation([paths[i] for i in back], np.full(len(back), 3.0)))
    assert abs(direction(only)) > 3.1


def test_ways_end_where_the_sensor_sees_a_wall():
    paths = primitives(6.0)
    free = np.full(len(paths), 3.0)
    free[0], free[1] = 0.5, 1.5
    kept, left = usable(paths, free, 3.0)
    assert len(kept) == len(paths) - 1 == len(left)
    assert kept[0].length == pytest.approx(1.5)
    assert kept[1].length == paths[2].length


def two_modes(tag, middles, sigmas, targets):
    """A belief of two equal modes in an empty hall with one tag, and the ways from the first of them to places far away."""
    middles, sigmas = np.array(middles), np.array(sigmas)
    particles = middles[np.arange(500) % 2] + np.random.default_rng(0).standard_normal((500, 3)) * sigmas
    modes = tuple(Mode(0.5, m, np.diag(sigmas**2)) for m in middles)
    ways = waypoint_paths(SPACE, middles[0], np.array(targets))
    base = situation((*primitives(3.0), *ways), tags=np.array((tag,)))
    return replace(base, particles=particles, modes=modes), ways


SURE = (0.1, 0.1, 0.02)


def test_of_two_places_a_far_one_that_tells_them_apart_is_chosen():
    """A tag stands 15 m away from where one of them says."""
    middles, targets = ((20.0, 20.0, 0.0), (20.0, 5.0, 0.0)), ((20.0, 34.0), (20.0, 6.0), (34.0, 20.0))
    s, ways = two_modes((20.0, 35.0, 1.2), middles, SURE, targets)
    choice = policy("information")(s)
    assert choice.path is ways[0]
    assert choice.metres > 3.0
    # of one place nothing is gained by going far
    assert policy("information")(replace(s, modes=s.modes[:1])).path is not ways[0]


def test_of_two_headings_at_one_place_a_far_tag_tells():
    """In the middle of a hall, looking one way or the other; a tag stands 15 m ahead of one."""
    middles = ((20.0, 20.0, math.pi / 2.0), (20.0, 20.0, -math.pi / 2.0))
    s, ways = two_modes((20.0, 35.0, 1.2), middles, SURE, ((20.0, 34.0), (34.0, 20.0)))
    assert policy("information")(s).path is ways[0]


def test_a_far_tag_that_both_places_would_read_alike_tells_nothing():
    """The modes are known to 0.2 m only: that the way ends 0.1 m beside the one of them and not the other is no difference."""
    middles = ((8.0, 20.0, 0.0), (32.0, 20.1, math.pi))
    s, _ = two_modes((20.0, 20.0, 1.2), middles, (0.2, 0.2, 0.05), ((19.0, 20.0),))
    assert policy("information")(s).path.kind == "patrol"


def test_they_go_where_landmarks_are():
    """Without a tag: two landmarks to the left, 9 m away, that are seen from 6 m."""
    world = World(landmarks={"A": {"x": 19.0, "y": 29.0}, "B": {"x": 21.0, "y": 29.0}})
    sensors = Sensors.of(world, RIG)
    choice = policy("information")(replace(situation(), sensors=sensors))
    assert abs(direction(choice) - math.pi / 2.0) < 0.8


def one_place(tags, candidates):
    """A situation with one place in the middle, known to 0.8 m and 0.1 rad, and what is seen from ways."""
    s = situation(candidates=candidates, tags=tags)
    mode = Mode(1.0, np.array((20.0, 20.0, 0.0)), np.diag((0.64, 0.64, 0.01)))
    return replace(s, modes=(mode,))


def test_one_place_too_wide_is_told_by_tags_far_away():
    far = np.array(((36.0, 20.0, 1.2), (36.0, 23.0, 1.2)))
    ways = waypoint_paths(SPACE, np.array((20.0, 20.0, 0.0)), np.array(((35.0, 21.0), (5.0, 20.0))))
    choice = policy("information")(one_place(far, (*primitives(3.0), *ways)))
    assert choice.path is ways[np.argmax([way.poses[-1, 0] for way in ways])]
    assert choice.metres == choice.path.length


def test_what_the_odometry_takes_away_is_no_gain():
    s, chosen = one_place(TAGS, primitives(3.0)), policy("information")
    net, gross = chosen(s).values, chosen(replace(s, modes=(), rng=one_place(TAGS, ()).rng)).values
    assert np.all(net < gross)

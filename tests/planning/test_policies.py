"""What policies choose, and the gains that they compare: against closed forms, enumeration and larger samples."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from factorgraph_loc import Rig, World
from factorgraph_loc.maps.free_space import free_space
from factorgraph_loc.model.belief import Mode
from factorgraph_loc.planning.information import (
    METRES_PER_RADIAN,
    POSITION,
    SPEED,
    Sensors,
    expected_gain,
    gaussian_entropy,
    has_several_modes,
    particle_entropy,
)
from factorgraph_loc.planning.paths import Path, full_turn, primitives, waypoint_paths
from factorgraph_loc.planning.policies import Situation, policy, usable
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.sensors.motion import odometry_model
from factorgraph_loc.sensors.rfid.forecast import RfidForecast
from factorgraph_loc.sensors.rfid.known_tags import tag_map
from factorgraph_loc.sensors.rfid.settings import RfidSettings
from factorgraph_loc.simulation import preset
from factorgraph_loc.simulation.settings import RACKHAM_RIG
from factorgraph_loc.simulation.worlds import make_world
from factors.odometry.model import Growth, OdometryModel
from factors.rfid.detection import RfidLikelihood, TagArray
from factors.rfid.model import Antenna, BeamModel, RfidModel

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
    sensors = Sensors.of(world, RIG, preset("office"), SPEED, SPEED / METRES_PER_RADIAN, ("landmarks",))
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


SPREAD = np.array(((0.8, 0.3, 0.01), (0.3, 0.5, -0.02), (0.01, -0.02, 0.05)))
HALL = World(
    walls=((-20.0, -5.0, 20.0, -5.0), (20.0, -5.0, 20.0, 5.0), (20.0, 5.0, -20.0, 5.0), (-20.0, 5.0, -20.0, -5.0))
)


def drawn(count, covariance=SPREAD, mean=(1.0, 2.0, 0.5), seed=0):
    poses = np.random.default_rng(seed).multivariate_normal(mean, covariance, count)
    return poses, np.full(count, 1.0 / count)


def beam(*points, tempering=1.0, antennas=8, **settings):
    """Antennas all around, with tags at their height that face nowhere."""
    around = tuple(Antenna(yaw=2.0 * math.pi * i / antennas) for i in range(antennas))
    model = RfidModel(around, (BeamModel(**settings),), 1e-3, 0.0, tempering)
    places = np.array([(x, y, 0.0) for x, y in points]).reshape(-1, 3)
    return reading(RfidLikelihood(model, TagArray(places, np.full(len(places), np.nan))))


def reading(likelihood):
    """A robot that reads tags alone."""
    return Sensors(OdometryModel(), (RfidForecast(likelihood),))


def straight(length):
    return next(p for p in primitives(length) if p.length > 0.9 * length and not p.poses[:, 1:].any())


@pytest.mark.parametrize("dims", [1, 2, 3])
def test_entropy_of_a_gaussian(dims):
    expected = stats.multivariate_normal(cov=SPREAD[:dims, :dims]).entropy()
    assert gaussian_entropy(SPREAD, dims) == pytest.approx(expected)
    np.testing.assert_allclose(gaussian_entropy(np.stack((SPREAD, SPREAD)), dims), expected)


def test_entropy_of_particles_is_that_of_the_density():
    rng = np.random.default_rng(0)
    area = rng.uniform((0.0, 0.0, -math.pi), (8.0, 5.0, math.pi), (20_000, 3))
    even = np.full(20_000, 1.0 / 20_000)
    # cells that are all within, and a hundred particles or more in each: less than 0.01 nats are lost
    assert particle_entropy(area, even, POSITION) == pytest.approx(math.log(40.0), abs=0.01)


@pytest.mark.parametrize("sigma", [0.05, 0.3, 1.0, 4.0])
def test_one_mode(sigma):
    poses, weights = drawn(2000, np.diag((sigma**2, 0.5 * sigma**2, 0.1)))
    assert not has_several_modes(poses, weights)


def test_several_modes():
    rng = np.random.default_rng(0)
    here, weights = drawn(2000, np.diag((0.09, 0.09, 0.01)))
    there = here.copy()
    there[::2, 0] += 6.0
    assert has_several_modes(there, weights)
    # unequal ones too
    far = here.copy()
    far[::20, 1] -= 12.0
    assert has_several_modes(far, weights)
    # a ring about a tag
    angle = rng.uniform(-math.pi, math.pi, 2000)
    ring = np.column_stack((4.0 * np.cos(angle), 4.0 * np.sin(angle), rng.normal(0.0, 0.1, 2000)))
    assert has_several_modes(ring + rng.normal(0.0, 0.1, (2000, 3)), weights)
    # a known place, but no heading
    assert has_several_modes(np.column_stack((here[:, :2], angle)), weights)


@pytest.mark.parametrize("tempering", [1.0, 0.4])
def test_two_places_are_told_apart_as_often_as_enumeration_says(tempering):
    """Half the particles where a tag is read with a known probability, half where it is read by mistake alone: the posterior after
    each number of reads, and how often there are so many, are exact. 512 scans: five standard deviations of their mean, at
    most log(2) / 2 each, are 0.08 nats."""
    (reads,) = beam((2.0, 0.0), tempering=tempering, antennas=1, p0=0.15, s_r=0.1).forecasts
    particles = np.concatenate((np.tile((0.1, 0.1, 0.0), (256, 1)), np.tile((30.1, 0.1, 0.0), (256, 1))))
    path = Path(np.array(((0.0, 0.0, 0.0), (0.25, 0.0, 0.0))), "arc")
    q = float(reads.likelihood.probabilities(np.array(((0.35, 0.1, 0.0),)), 0)[0, 0])
    rounds, floor = 10, 1e-3
    after = 0.0
    for here in (True, False):
        for k in range(rounds + 1):
            # false reads beyond reach are not drawn
            chance = stats.binom.pmf(k, rounds, q) if here else float(k == 0)
            likelihoods = [(p**k * (1.0 - p) ** (rounds - k)) ** tempering for p in (q, floor)]
            share = likelihoods[0] / sum(likelihoods)
            after += 0.5 * chance * stats.entropy((share, 1.0 - share))
    (gain,) = expected_gain(
        Sensors(OdometryModel(), (replace(reads, rounds_per_metre=4.0 * rounds),)),
        particles,
        np.full(512, 1.0 / 512),
        [path],
        np.random.default_rng(0),
        samples=512,
        scans=512,
    )
    assert gain == pytest.approx(math.log(2.0) - after, abs=0.08)
    assert 0.2 < gain < 0.6


def test_what_lies_behind_a_wall_is_not_scanned():
    """Two places at which the robot may be, and a tag that is read only from 10 m farther on at one of them; but a wall is near."""
    here, weights = drawn(2000, np.diag((0.05, 0.05, 1e-4)), mean=(9.0, 0.0, 0.0))
    here[::2, 0] = here[::2, 0] - 20.0
    found = beam((23.5, 0.0), r_max=2.0, s_r=0.1)
    path = [straight(14.0)]
    (free,) = expected_gain(found, here, weights, path, np.random.default_rng(0))
    (walled,) = expected_gain(found, here, weights, path, np.random.default_rng(0), space=free_space(HALL, 0.3))
    assert free > 0.5
    assert walled == pytest.approx(0.0, abs=0.1)


def test_random_numbers_are_common_to_all_paths():
    poses, weights = drawn(500)
    found, paths = beam((4.0, 2.0), (-1.0, 4.0)), primitives(3.0)[:10]
    noise = OdometryModel(along=Growth(0.02), lateral=Growth(0.01), heading=Growth(0.03))
    gains = expected_gain(found, poses, weights, paths, np.random.default_rng(3), noise=noise)
    again = expected_gain(found, poses, weights, paths[::-1], np.random.default_rng(3), noise=noise)
    np.testing.assert_array_equal(again[::-1], gains)
    same = expected_gain(found, poses, weights, [paths[0]] * 2, np.random.default_rng(3), noise=noise)
    assert same[0] == same[1]
    other = expected_gain(found, poses, weights, paths, np.random.default_rng(4), noise=noise)
    assert not np.array_equal(other, gains)
    # so the difference of two that are alike scatters less than they themselves
    alike = [straight(3.0), straight(2.5)]
    many = np.array([expected_gain(found, poses, weights, alike, np.random.default_rng(k)) for k in range(30)])
    assert np.std(many[:, 0] - many[:, 1]) < 0.8 * np.hypot(*many.std(axis=0))


def test_weights_of_the_belief_are_respected():
    poses, weights = drawn(2000, np.diag((0.1, 0.1, 0.01)))
    both = np.concatenate((poses, poses + np.array((50.0, 0.0, 0.0))))
    paths = [straight(3.0)]
    found = beam((4.0, 3.0))
    (alone,) = expected_gain(found, poses, weights, paths, np.random.default_rng(0), samples=1000, scans=200)
    ignored = np.concatenate((weights, np.zeros(2000)))
    (same,) = expected_gain(found, both, ignored, paths, np.random.default_rng(0), samples=1000, scans=200)
    assert same == pytest.approx(alone, abs=0.15)


def test_a_small_sample_chooses_nearly_as_well_as_a_large_one():
    """In an office, from a belief of one place: what is lost by the choice of the default sample is little of what there is to
    choose. Turns in place tell nothing here: they make all paths more alike."""
    settings = preset("office")
    world = make_world(settings.world, np.random.default_rng(3))
    space = free_space(world, 0.3)
    rfid: RfidSettings = settings.rig.rfid
    found = reading(RfidLikelihood(rfid.model(), tag_map(world, settings.rig.survey).tags))
    found = replace(found, metres_per_radian=0.0)
    mean = np.append(space.centres[len(space.centres) // 3], 0.4)
    poses, weights = drawn(2000, np.diag((0.6**2, 0.6**2, 0.3**2)), mean)
    paths = primitives(6.0)

    def gains(seed, **samples):
        rng = np.random.default_rng(seed)
        return expected_gain(found, poses, weights, paths, rng, space=space, **samples)

    large = gains(9, samples=2000, scans=300)
    lost = [large.max() - large[np.argmax(gains(k))] for k in range(5)]
    assert np.mean(lost) < 0.35 * (large.max() - large.mean())


def test_a_turn_in_place_tells_something_but_not_without_rounds():
    poses, weights = drawn(1000)
    found, turn = beam((4.0, 2.0), (-1.0, 4.0)), [full_turn()]
    assert turn[0].length == 0.0
    assert turn[0].passed(0.5)[-1] == pytest.approx(np.pi)
    (gain,) = expected_gain(found, poses, weights, turn, np.random.default_rng(0))
    slow, fast = replace(found, metres_per_radian=2.0), replace(found, metres_per_radian=0.0)
    (more,) = expected_gain(slow, poses, weights, turn, np.random.default_rng(0))
    (none,) = expected_gain(fast, poses, weights, turn, np.random.default_rng(0))
    assert more > gain > 0.1
    assert none == pytest.approx(0.0, abs=1e-5)

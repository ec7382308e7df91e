"""Walls between antennas and tags."""

import math
from dataclasses import replace

import numpy as np
import pytest

from factors import se2
from factors.rfid.counts import TagReadCounts
from factors.rfid.detection import RfidLikelihood, TagArray
from factors.rfid.model import Antenna, BeamModel, LogisticModel, RfidModel, bake
from factors.rfid.tag_states import TagStates
from factors.walls import NO_WALLS, all_farther, moved, walls_around

LOGISTIC = LogisticModel((5.0, -0.6, -0.1, -3.0, 0.2, -0.1, -0.5, 1.5, 0.3, 0.1, -0.2))
MODELS = {
    "beam": BeamModel(),
    "logistic": LOGISTIC,
    "grid": bake(BeamModel(), 8.0, 0.3, (0.0,)),
    "facing": bake(LOGISTIC, 8.0, 0.3, (-0.4, 0.0, 0.4), 5),
}
ANTENNAS = tuple(Antenna(0.2, 0.1 * k, 1.0, 1.5 * k) for k in range(4))
POSE = np.array((10.0, 6.0, 0.4))


def random_walls(rng, count, size, attenuation):
    start = rng.uniform(0.0, size, (count, 2))
    angle, length = rng.uniform(-3.0, 3.0, count), rng.uniform(0.5, 6.0, count)
    end = start + length[:, None] * np.column_stack((np.cos(angle), np.sin(angle)))
    return np.column_stack((start, end, rng.choice(attenuation, count)))


def crossed(wall, a, b):
    """Whether two segments cross, by solving for the point where they do."""
    (x, y), along, way = wall[:2], wall[2:4] - wall[:2], b - a
    share = np.linalg.solve(np.column_stack((way, -along)), np.array((x, y)) - a)
    return bool(np.all((share > 0.0) & (share < 1.0)))


def test_attenuations_of_all_walls_between_two_places_add_up():
    rng = np.random.default_rng(1)
    segments = random_walls(rng, 60, (20.0, 12.0), (0.0, 3.0, 7.0))
    antennas = rng.uniform(-5.0, (25.0, 17.0), (80, 2))
    way = rng.uniform(0.0, 8.0, 80)[:, None] * np.stack(
        [(math.cos(a), math.sin(a)) for a in rng.uniform(-3.0, 3.0, 80)]
    )
    walls = walls_around(segments, 8.0)
    found = [all_farther(walls, a[None], b[None])[0, 0] for a, b in zip(antennas, antennas + way, strict=True)]
    total = [sum(w[4] for w in segments if crossed(w, a, a + d)) for a, d in zip(antennas, way, strict=True)]
    assert max(total) > 7.0
    np.testing.assert_allclose(20.0 * np.log10(found), total, atol=1e-9)


@pytest.mark.parametrize("name", MODELS)
def test_a_tag_behind_a_wall_is_read_like_one_farther_away(name):
    """20 log10(1.5) = 3.52 dB."""
    places, facing = np.array(((2.0, 0.5, 1.2), (3.0, -1.0, 1.0))), np.array((3.0, -2.0))
    model = RfidModel((Antenna(0.0, 0.0, 1.0, 0.2),), (MODELS[name],), 0.01)
    wall = np.array(((1.0, -5.0, 1.0, 5.0, 20.0 * math.log10(1.5)), (0.5, 3.0, 5.0, 3.0, 9.0)))
    farther = places * (1.5, 1.5, 1.0)
    at = np.zeros((1, 3))
    behind = RfidLikelihood(model, TagArray(places, facing, wall)).probabilities(at, 0)
    np.testing.assert_allclose(behind, RfidLikelihood(model, TagArray(farther, facing)).probabilities(at, 0), rtol=1e-9)
    open_ = RfidLikelihood(model, TagArray(places, facing)).probabilities(at, 0)
    assert np.all(behind < open_)
    # from the tags' side of it
    inside = at + np.array((1.2, 0.0, 0.0))
    here = RfidLikelihood(model, TagArray(places, facing, wall)).probabilities(inside, 0)
    np.testing.assert_array_equal(here, RfidLikelihood(model, TagArray(places, facing)).probabilities(inside, 0))
    blocked = replace(TagArray(places, facing), walls=np.array(((1.0, -5.0, 1.0, 5.0, 60.0),)))
    assert RfidLikelihood(model, blocked).probabilities(at, 0) == pytest.approx(0.01, abs=1e-5)


def scene(detection, tempering=0.7):
    rng = np.random.default_rng(3)
    count = 60
    points = np.column_stack((rng.uniform(0.0, (20.0, 12.0), (count, 2)), rng.choice((0.8, 1.2), count)))
    facing = rng.uniform(-3.0, 3.0, count) if detection.uses_facing else np.full(count, np.nan)
    tags = TagArray(points, facing, random_walls(rng, 30, (20.0, 12.0), (2.0, 4.0)))
    likelihood = RfidLikelihood(RfidModel(ANTENNAS, (detection,), 0.01, 0.0, tempering), tags)
    chance = np.stack([likelihood.probabilities(POSE[None], k)[0] for k in range(len(ANTENNAS))])
    hits = rng.binomial(2, chance)
    odds = np.full(count, -2.7)
    looks = TagReadCounts(np.zeros((len(ANTENNAS), 3)), np.arange(len(ANTENNAS)), np.full(len(ANTENNAS), 2), hits, odds)
    return likelihood, looks, rng


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("parameters", [(0.0, 0.0), (0.1, -0.3)])
def test_tables_of_particles_and_of_a_search_know_the_walls(name, parameters):
    """Cells of 5 cm. A search takes walls for those from the robot's middle, where the model has tables of places: of a few tags at
    the ends of walls it is mistaken then. The likelihoods differ by tens."""
    likelihood, looks, rng = scene(MODELS[name])
    likelihood = likelihood.adjusted(np.array(parameters))
    near = POSE + rng.normal(size=(300, 3)) * (0.5, 0.5, 0.2)
    anywhere = rng.uniform((0.0, 0.0, -3.0), (20.0, 12.0, 3.0), (300, 3))
    without = RfidLikelihood(likelihood.model, replace(likelihood.tags, walls=NO_WALLS)).adjusted(np.array(parameters))
    in_search = 0.15 if likelihood.model.models[0].uses_facing else 1.6
    for poses, close in ((near, 0.3), (np.concatenate((near, anywhere)), in_search)):
        exact = -likelihood.score(poses, looks).nll
        found = likelihood.log_likelihood(poses, looks) - exact
        assert np.median(found) == pytest.approx(0.0, abs=0.1)
        assert np.std(found) < close
        assert np.std(-without.score(poses, looks).nll - exact) > 2.5 * close


def test_a_tag_that_moved_is_looked_for_behind_the_walls():
    likelihood, looks, _ = scene(MODELS["beam"])
    poses = POSE + np.zeros((1, 3))
    shifts = TagStates(60, 0.03, 0.03).places[1:7]
    tags, found, _ = likelihood.displaced(poses, looks, shifts, 0.0, likelihood.parameters, np.zeros(60))
    for i, shift in enumerate(shifts):
        points = likelihood.tags.points + np.array((*shift, 0.0))
        there = RfidLikelihood(likelihood.model, replace(likelihood.tags, points=points))
        silence = -looks.rounds.sum() * math.log1p(-0.01 - 0.99 / (1.0 + math.exp(14.0)))
        told = -there.by_tag(POSE, looks)[0][tags] + likelihood.model.tempering * silence
        np.testing.assert_allclose(found[:, i], told, atol=0.3)
        assert np.std(found[:, i] - told) < 0.1 * np.std(told)


@pytest.mark.parametrize("name", MODELS)
def test_the_gradient_is_that_between_the_ends_of_walls(name):
    likelihood, looks, _ = scene(MODELS[name])
    step = 1e-7
    sides = [
        [likelihood.score(se2.compose(POSE, se2.exp(s * step * e)), looks).nll[0] for s in (1, -1)] for e in np.eye(3)
    ]
    numeric = [(a - b) / (2.0 * step) for a, b in sides]
    assert likelihood.score(POSE, looks).gradient[0] == pytest.approx(numeric, abs=1e-2, rel=1e-3)


def test_walls_turn_with_the_frame_of_their_survey():
    rng = np.random.default_rng(5)
    segments, transform = random_walls(rng, 20, (10.0, 10.0), (3.0,)), np.array((1.0, -2.0, 0.7))
    a, b = rng.uniform(0.0, 10.0, (2, 30, 2))
    here = all_farther(walls_around(segments, 15.0), a, b)
    placed = walls_around(moved(segments, transform), 15.0)
    there = all_farther(placed, se2.transform_from(transform, a), se2.transform_from(transform, b))
    np.testing.assert_allclose(here, there, rtol=1e-9)
    assert here.max() > 2.0

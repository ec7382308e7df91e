"""Maps from learnt landmarks: brought onto a given map whose landmarks may be wrong, which are then found, and no others."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from factorgraph_loc import BearingRangeStream, Landmark, Log, Rig, World
from factorgraph_loc.mapping.mapping import TOLERANCE, align_robustly, make_map
from factorgraph_loc.model.belief import LearntPoint
from factorgraph_loc.sensors.landmarks.measurement import BearingRangeSettings
from factors import se2

FRAME = np.array((3.0, -2.0, 2.0))  # of the run in the map
SIGMA = 0.03
RIG = Rig(bearing_range=BearingRangeSettings(range_sigma=0.1))


def places(count=12, seed=0):
    """Landmarks in a room of 10 m by 8 m, no two nearer than a metre."""
    rng = np.random.default_rng(seed)
    out = []
    while len(out) < count:
        place = rng.uniform((0.0, 0.0), (10.0, 8.0))
        if all(np.hypot(*(place - other)) > 1.0 for other in out):
            out.append(place)
    return np.array(out)


def world(points, **settings):
    return World(landmarks={str(i): Landmark(x=x, y=y, **settings) for i, (x, y) in enumerate(points.tolist())})


def learnt(points, seed=1, sigma=SIGMA, stated=SIGMA):
    """What a run in its own frame makes of landmarks at ``points``: error of ``sigma``, covariance of ``stated``."""
    rng = np.random.default_rng(seed)
    own = se2.transform_to(FRAME, points) + sigma * rng.standard_normal(points.shape)
    return {str(i): LearntPoint(point, stated**2 * np.eye(2)) for i, point in enumerate(own)}


def log(given):
    stream = BearingRangeStream(np.arange(2.0), ["0", "1"], np.ones(2), np.zeros(2))
    return Log("hall", RIG, given, {"bearing_range": stream})


def verdicts(made):
    return {entry.landmark: entry.verdict for entry in made.entries}


def test_a_right_map_agrees_and_the_new_one_is_in_its_frame():
    points = places()
    made = make_map(log(world(points)), learnt(points))
    assert made.judged
    assert set(verdicts(made).values()) == {"agrees"}
    assert made.flagged == ()
    np.testing.assert_allclose(made.world.positions(), points, atol=5.0 * SIGMA)
    np.testing.assert_allclose(made.frame, FRAME, atol=0.1)


@pytest.mark.parametrize("stated", [0.02, 0.03, 0.2])
def test_wrong_landmarks_are_found_and_no_others_however_cautious_the_covariances(stated):
    points = places()
    found = learnt(points, stated=stated)
    wrong = points.copy()
    wrong[[2, 7]] = wrong[[7, 2]]
    wrong[4] += (0.6, -0.8)
    made = make_map(log(world(wrong)), found)
    assert made.flagged == ("2", "4", "7")
    said = verdicts(made)
    assert said["2"] == "swapped with 7"
    assert said["7"] == "swapped with 2"
    assert float(said["4"].removeprefix("moved by ").removesuffix(" m")) == pytest.approx(1.0, abs=0.15)
    np.testing.assert_allclose(made.world.positions(), points, atol=5.0 * SIGMA)
    assert "3 wrong in the given map (2, 4, 7)" in made.summary()


def test_five_of_twelve_may_be_wrong():
    points = places()
    wrong = points.copy()
    wrong[:5] += np.random.default_rng(3).uniform(1.0, 3.0, (5, 2))
    assert make_map(log(world(wrong)), learnt(points)).flagged == ("0", "1", "2", "3", "4")


def test_nothing_is_doubted_below_the_tolerance():
    points = places()
    moved = points.copy()
    moved[3, 0] += TOLERANCE - 0.02
    exact = learnt(points, sigma=1e-4, stated=1e-4)
    assert make_map(log(world(moved)), exact).flagged == ()
    moved[3, 0] += 0.04
    assert make_map(log(world(moved)), exact).flagged == ("3",)


def test_an_uncertain_landmark_is_not_doubted():
    points = places()
    moved = points.copy()
    moved[3, 0] += 0.4
    found = learnt(points)
    assert make_map(log(world(moved)), found).flagged == ("3",)
    found["3"] = replace(found["3"], covariance=0.3**2 * np.eye(2))
    assert make_map(log(world(moved)), found).flagged == ()
    surveyed = world(moved).landmarks | {"3": Landmark(x=moved[3, 0], y=moved[3, 1], sigma=0.3)}
    assert make_map(log(World(landmarks=surveyed)), learnt(points)).flagged == ()


def test_covariances_are_scaled_to_what_the_landmarks_show():
    """Stated deviations are five times too large. The scaled squared errors of 60 maps of 12 landmarks would have a mean of 2, were
    the alignment exact; as it fits the errors and adds its own uncertainty, it is less. Its standard deviation is about 0.1."""
    points = places()
    squared = []
    for seed in range(60):
        made = make_map(log(world(points)), learnt(points, seed=seed, stated=5.0 * SIGMA))
        for entry in made.entries:
            error = entry.learnt.position - entry.given
            squared.append(error @ np.linalg.solve(entry.learnt.covariance, error))
    assert 1.2 < np.mean(squared) < 2.2


def test_false_alarms_are_as_rare_as_the_gate_says():
    """Errors of 0.1 m, so that the tolerance hides few; 50 maps of 12; the bound is passed by chance once in 10 000."""
    points = places()
    alarms = sum(
        len(make_map(log(world(points)), learnt(points, seed=seed, sigma=0.1, stated=0.2)).flagged)
        for seed in range(50)
    )
    assert alarms <= binom.ppf(1.0 - 1e-4, 600, 1e-3)


def test_landmarks_that_were_not_seen_are_kept_and_new_ones_taken_in():
    points = places()
    found = learnt(points)
    del found["5"]
    made = make_map(log(world(points[:10], sigma=0.01)), found)
    said = verdicts(made)
    assert said["5"] == "not seen"
    assert said["10"] == said["11"] == "new"
    assert made.world.landmarks["5"] == Landmark(x=points[5, 0], y=points[5, 1], sigma=0.01)
    np.testing.assert_allclose(made.world.position("11"), points[11], atol=0.2)
    assert made.world.landmarks["11"].covariance is not None
    assert made.unseen == ("5",)


def test_without_a_map_all_is_new_and_in_the_frame_of_the_start():
    found = learnt(places(4))
    made = make_map(log(World()), found)
    assert set(verdicts(made).values()) == {"new"}
    np.testing.assert_array_equal(made.world.position("2"), found["2"].position)
    assert not made.judged


def test_extending_keeps_the_given_map():
    points = places(6)
    found = {name: point for name, point in learnt(points).items() if name in ("4", "5")}
    made = make_map(log(world(points[:4])), found, extend=True)
    assert list(verdicts(made).values()) == ["given"] * 4 + ["new"] * 2
    assert made.world.landmarks["1"] == world(points).landmarks["1"]
    np.testing.assert_array_equal(made.world.position("5"), found["5"].position)


def test_too_few_common_landmarks_are_not_judged():
    points = places(6)
    made = make_map(log(world(points[:2])), learnt(points))
    assert not made.judged
    assert "only 2 of the given map's landmarks" in str(made.notes[0])
    assert verdicts(made)["0"] == "not judged"
    np.testing.assert_array_equal(made.world.position("0"), learnt(points)["0"].position)


def test_a_map_of_another_place_is_not_judged():
    made = make_map(log(world(places(8, seed=5))), learnt(places(8), stated=0.01))
    assert not made.judged
    assert made.notes[0].kind == "few_inliers"


def test_many_landmarks_are_aligned_by_a_sample_of_pairs():
    points = np.random.default_rng(4).uniform(-50.0, 50.0, (150, 2))
    wrong = points.copy()
    wrong[:60] = np.random.default_rng(5).permutation(wrong[:60])
    alignment = align_robustly([*learnt(points).values()], wrong, np.zeros((150, 2, 2)))
    np.testing.assert_allclose(alignment.pose, FRAME, atol=0.05)

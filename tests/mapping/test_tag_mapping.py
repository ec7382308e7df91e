"""Tags mapped along a known way and from odometry: right within their covariances, and silent where the reads do not tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from factorgraph_loc import InputError, Log, Tag, World
from factorgraph_loc.mapping.tag_mapping import map_tags
from factorgraph_loc.mapping.tag_search import merged, search
from factorgraph_loc.mapping.tag_slam import INTERVAL, _keyframes
from factorgraph_loc.model.belief import PosePrior
from factorgraph_loc.sensors.rfid.settings import SurveySettings
from factorgraph_loc.simulation.settings import preset
from factorgraph_loc.simulation.simulate import simulate
from factors import se2
from factors.rfid.detection import RfidLikelihood, TagArray, TagReadCounts
from factors.rfid.model import Antenna, BeamModel, LogisticModel, RfidModel

SMALL = {"world": {"width": 7.0, "depth": 6.5, "tags": 8}, "drive": {"duration": 60.0}}
SIDEWAYS = (Antenna(z=1.0, yaw=np.pi / 2.0), Antenna(z=1.0, yaw=-np.pi / 2.0))


@pytest.fixture(scope="module")
def room() -> Log:
    return simulate(preset("office", SMALL), 3)


def squares(made, truth):
    """Squared errors of the learnt tags in units of their covariances."""
    out = []
    for entry in made.made.entries:
        if entry.learnt is not None:
            error = entry.learnt.position - (truth[entry.landmark].x, truth[entry.landmark].y)
            out.append(error @ np.linalg.solve(entry.learnt.covariance, error))
    return np.array(out)


def drawn(model, tags, poses, antennas, rng):
    """Looks of all ``antennas`` from each of the poses."""
    likelihood = RfidLikelihood(model, tags)
    offsets, which = np.repeat(poses, len(antennas), axis=0), np.tile(antennas, len(poses))
    p = np.empty((len(offsets), len(tags.points)))
    for a in antennas:
        p[which == a] = likelihood.probabilities(offsets[which == a], a)
    return TagReadCounts(
        offsets, which, np.ones(len(which), dtype=np.int64), (rng.random(p.shape) < p).astype(np.int64)
    )


def straight(length=8.0, step=0.1):
    x = np.arange(0.0, length, step)
    return np.column_stack((x, 0.0 * x, 0.0 * x))


def test_along_the_reference_errors_are_as_large_as_stated():
    """Tags of four rooms; the bounds of the mean are passed by chance, were errors Gaussian, once in a thousand on either side."""
    found = []
    for seed in range(4):
        log = simulate(preset("office", SMALL), seed)
        found.append(squares(map_tags(log, "reference", None), log.world.tags))
    every = np.concatenate(found)
    assert len(every) >= 27
    low, high = chi2.ppf((1e-3, 1.0 - 1e-3), 2 * len(every)) / len(every)
    assert low < every.mean() < high


PHASES = {"phase": {"sigma": 0.1, "flips": 0.2}, "rig": {"rfid": {"phase": {"max_range": 4.0}}}}


@pytest.fixture(scope="module")
def phased() -> Log:
    return simulate(preset("office", SMALL | PHASES), 3)


def test_phases_along_the_reference_make_tags_more_exact(phased):
    """Were errors Gaussian, their mean square would exceed the bound once in a thousand."""
    log = phased
    without = log.rig.model_copy(update={"rfid": log.rig.rfid.model_copy(update={"phase": None})})
    coarse, fine = (map_tags(replace(log, rig=rig), "reference", None) for rig in (without, log.rig))
    assert len(fine.world.tags) == len(coarse.world.tags) == 8
    assert fine.rms < 0.6 * coarse.rms
    assert squares(fine, log.world.tags).mean() < chi2.ppf(0.999, 16) / 8


def test_tags_of_unknown_height_are_not_moved_by_their_phases(phased):
    log = phased
    without = log.rig.model_copy(update={"rfid": log.rig.rfid.model_copy(update={"phase": None})})
    both = [map_tags(replace(log, rig=rig, world=World()), "reference", None).world.tags for rig in (without, log.rig)]
    assert both[0] == both[1]


def test_from_odometry_alone_tags_and_way_are_found(room):
    """In the frame of the true start. Eight correlated squares: their mean has no exact distribution, so the bound is wide."""
    start = PosePrior(0.0, room.reference.poses[0], 1e-6 * np.eye(3))
    alone = replace(room, reference=None, world=World())
    made = map_tags(alone, "odometry", start, height=1.2)
    assert len(made.world.tags) >= 6
    assert squares(made, room.world.tags).mean() < 6.0
    errors = made.poses[:, :2] - room.reference.at(np.arange(len(made.poses), dtype=float))[:, :2]
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.3
    assert all(tag.facing is None and tag.z == 1.2 for tag in made.world.tags.values())


def test_known_tags_stay_and_the_others_come_into_their_frame(room):
    names = list(room.world.tags)
    part = room.world.model_copy(update={"tags": {n: room.world.tags[n] for n in names[:5]}})
    start = PosePrior(0.0, room.reference.poses[0], np.diag((0.1, 0.1, 0.05)) ** 2)
    made = map_tags(replace(room, world=part, reference=None), "odometry", start, extend=True)
    assert {n: made.world.tags[n] for n in names[:5]} == part.tags
    new = [n for n in made.world.tags if n not in part.tags]
    assert new
    for name in new:
        written, truth = made.world.tags[name], room.world.tags[name]
        assert np.hypot(written.x - truth.x, written.y - truth.y) < 0.6


def test_what_is_written_is_in_the_frame_of_the_survey(room):
    survey = SurveySettings(x=0.3, y=-0.2, heading=0.1, about_x=2.0, about_y=1.0)
    inverse = se2.inverse(survey.transform())
    moved = {}
    for name, tag in room.world.tags.items():
        x, y = se2.transform_from(inverse, np.array((tag.x, tag.y))).tolist()
        moved[name] = tag.model_copy(update={"x": x, "y": y, "facing": tag.facing + inverse[2]})
    rig = room.rig.model_copy(update={"survey": survey})
    made = map_tags(replace(room, rig=rig, world=World(tags=moved)), "reference", None)
    plain = map_tags(room, "reference", None)
    assert made.rms == pytest.approx(plain.rms, rel=1e-6)
    for name in plain.world.tags:
        there = se2.transform_from(inverse, np.array((plain.world.tags[name].x, plain.world.tags[name].y)))
        np.testing.assert_allclose((made.world.tags[name].x, made.world.tags[name].y), there, atol=1e-6)


def test_mirror_images_of_a_straight_pass_are_reported_and_not_written():
    """An antenna that reads all around cannot tell left from right."""
    model = RfidModel((Antenna(z=1.0),), (BeamModel(sigma_phi=9.0),))
    tags = TagArray(np.array([(4.0, 1.5, 1.0)]), np.array([np.nan]))
    looks = drawn(model, tags, straight(), [0], np.random.default_rng(1))
    (found,) = search(model, looks, np.array([1.0]), np.array([np.nan]))
    assert found.is_explained
    assert found.is_ambiguous
    assert not found.is_located
    assert [m.weight for m in found.modes[:2]] == pytest.approx([0.5, 0.5], abs=0.05)
    sides = sorted(m.position[1] for m in found.modes[:2])
    assert sides[0] == pytest.approx(-sides[1], abs=0.02)
    assert sides[1] == pytest.approx(1.5, abs=0.7)


def test_antennas_to_the_sides_tell_left_from_right():
    model = RfidModel(SIDEWAYS, (BeamModel(),))
    tags = TagArray(np.array([(4.0, 1.5, 1.0), (2.0, -2.0, 1.0)]), np.full(2, np.nan))
    looks = drawn(model, tags, straight(), [0, 1], np.random.default_rng(2))
    for found, point in zip(search(model, looks, np.ones(2), np.full(2, np.nan)), tags.points, strict=True):
        assert found.is_explained
        right = sum(mode.weight for mode in found.modes if mode.position[1] * point[1] > 0.0)
        assert right > 0.999
        error = found.modes[0].position - point[:2]
        assert error @ np.linalg.solve(found.modes[0].covariance, error) < chi2.ppf(0.999, 2)


def test_a_facing_that_matters_is_estimated():
    model = RfidModel(SIDEWAYS, (LogisticModel((3.0, -0.8, -0.1, -2.0, 0.0, 0.0, 0.0, 2.5, 0.0, 0.0, 0.0)),))
    tags = TagArray(np.array([(4.0, 1.5, 1.0), (3.0, -1.5, 1.0)]), np.array([-1.2, 1.9]))
    looks = drawn(
        model,
        tags,
        np.concatenate((straight(), se2.compose(np.array((0.0, 0.4, 0.0)), straight()))),
        [0, 1],
        np.random.default_rng(3),
    )
    for found, facing in zip(search(model, looks, np.ones(2), np.full(2, np.nan)), tags.facing, strict=True):
        assert abs(se2.wrap_scalar(found.modes[0].facing - facing)) < np.pi / 4.0


def test_a_few_false_reads_are_no_tag():
    model = RfidModel(SIDEWAYS, (BeamModel(),))
    looks = drawn(
        model, TagArray(np.array([(90.0, 0.0, 1.0)]), np.full(1, np.nan)), straight(), [0, 1], np.random.default_rng(4)
    )
    looks.hits[[10, 100]] = 1
    (found,) = search(model, looks, np.ones(1), np.full(1, np.nan))
    assert found.reads == 2
    assert not found.is_explained


def test_merged_looks_count_the_same():
    model = RfidModel(SIDEWAYS, (BeamModel(),))
    tags = TagArray(np.array([(4.0, 1.5, 1.0), (2.0, -2.0, 1.0)]), np.full(2, np.nan))
    looks = drawn(model, tags, straight(), [0, 1], np.random.default_rng(5))
    fewer = merged(looks, 0.25, 0.1)
    assert len(fewer.rounds) < len(looks.rounds) / 2
    assert fewer.rounds.sum() == looks.rounds.sum()
    for antenna in (0, 1):
        before, after = looks.hits[looks.antennas == antenna], fewer.hits[fewer.antennas == antenna]
        np.testing.assert_array_equal(before.sum(axis=0), after.sum(axis=0))


def test_tags_that_were_never_read_are_listed_and_kept(room):
    far = room.world.model_copy(update={"tags": {**room.world.tags, "far": Tag(x=80.0, y=0.0, z=1.2)}})
    made = map_tags(replace(room, world=far), "reference", None)
    assert made.open["far"].kind == "unread"
    assert made.world.tags["far"] == far.tags["far"]


def test_from_an_unknown_start_the_map_is_brought_onto_the_given_one_with_its_facings(room):
    made = map_tags(replace(room, reference=None), "odometry", None)
    assert made.made.judged
    assert made.rms < 0.6
    for name, tag in made.world.tags.items():
        assert se2.wrap_scalar(tag.facing - room.world.tags[name].facing) == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(InputError, match="prior is None, expected the start pose"):
        map_tags(room, "odometry", None, extend=True)


def test_a_clock_that_jumps_makes_no_keyframes():
    stamps = np.array((0.0, 1.0, 2.5, 1.7e9, 1.7e9 + 1.0))
    times = _keyframes(0.0, stamps[-1], stamps)
    assert times[0] == 0.0
    assert np.all((times <= 2.5) | (times > 1.7e9 - INTERVAL))
    assert np.all(np.diff(times) > 0.0)
    assert len(times) <= 2 + 3.5 / INTERVAL + 2
    near = np.arange(0.0, 100.0, 30.0)
    assert _keyframes(0.0, 90.0, near).tolist() == (INTERVAL * np.arange(int(90.0 / INTERVAL) + 1)).tolist()

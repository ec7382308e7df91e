"""Pixels of named points: where they are, which are in sight, how they err."""

import numpy as np
import pytest

from factorgraph_loc import InputError, PointMap, World
from factorgraph_loc.maps.free_space import distance_to_walls
from factorgraph_loc.sensors.camera.settings import PixelSettings
from factorgraph_loc.sensors.camera.simulation import pixel_stream, surface_normals
from factorgraph_loc.simulation import preset
from factorgraph_loc.simulation.worlds import STANDOFF
from factors.camera import model as reprojection


@pytest.fixture(scope="module")
def seen(make):
    return make(2, world={"points": 800})


def test_points_are_named_and_lie_on_surfaces(seen):
    points = seen.world.points
    assert points.names[:2] == ("P0000", "P0001")
    assert len(points) == 800
    distance = distance_to_walls(seen.world, points.positions[:, :2])
    assert distance.max() < STANDOFF + 2e-3
    # a few beside the corner of a wall and a cupboard are nearer to that
    assert (distance > STANDOFF - 2e-3).mean() > 0.98
    z = points.positions[:, 2]
    assert z.min() < 0.4
    assert z.max() > 2.1
    assert ((z >= 0.3) & (z <= 2.2)).all()


def test_points_change_nothing_else(make, seen):
    plain = make(2)
    assert plain.world.points is None
    assert plain.rig.sensors == ("odometry", "rfid")
    assert seen.rig.sensors == ("odometry", "rfid", "sightings")
    assert plain.world.tags == seen.world.tags
    assert plain.reference.poses.tobytes() == seen.reference.poses.tobytes()
    assert repr(plain.streams["rfid"]) == repr(seen.streams["rfid"])


def test_pixels_err_as_the_rig_says(seen):
    """Mean and variance within five standard errors."""
    stream, model = seen.streams["sightings"], seen.rig.camera.model()
    rows = [seen.world.points.index[name] for name in stream.point]
    positions = seen.world.points.positions[rows]
    poses = seen.reference.at(stream.t)
    expected = [reprojection.predict(model, pose, p[None]) for pose, p in zip(poses, positions, strict=True)]
    pixels = np.concatenate([uv for uv, _ in expected])
    depths = np.concatenate([depth for _, depth in expected])
    errors = (np.column_stack((stream.u, stream.v)) - pixels) / model.sigma
    assert len(errors) > 1000
    assert (np.abs(errors.mean(axis=0)) < 5.0 / np.sqrt(len(errors))).all()
    assert (np.abs(errors.var(axis=0) - 1.0) < 5.0 * np.sqrt(2.0 / len(errors))).all()
    assert model.contains(pixels).all()
    assert ((depths >= 0.3) & (depths <= 10.0)).all()
    assert np.unique(stream.t, return_counts=True)[1].max() == 20


def test_what_is_behind_a_wall_or_edge_on_or_out_of_view_is_not_seen(seen):
    walls = ((3.0, -1.0, 3.0, 1.0), (5.0, -4.0, 5.0, 4.0), (0.0, 1.5, 9.0, 1.5))
    places = {
        "before": (2.98, 0.5, 1.0),
        "other side": (3.02, 0.5, 1.0),
        "behind": (4.98, 0.0, 1.0),
        "beside": (4.98, -2.0, 1.0),
        "oblique": (8.0, 1.48, 1.0),
        "too high": (2.98, 0.0, 4.0),
        "back": (-2.0, 1.48, 1.0),
    }
    world = World(points=PointMap.of(list(places), np.array(list(places.values()))), walls=walls)
    model = seen.rig.camera.model()
    stream = pixel_stream(model, world, np.ones(1), np.zeros((1, 3)), PixelSettings(), np.random.default_rng(0))
    assert list(stream.point) == ["before", "beside"]
    np.testing.assert_allclose(surface_normals(world, np.array(((3.1, 0.0), (2.9, 0.0)))), ((1.0, 0.0), (-1.0, 0.0)))


def test_a_share_of_wrong_points_is_far_off(make):
    log = make(1, world={"points": 300}, pixels={"wrong": 0.4, "rate": 2.0})
    stream, model = log.streams["sightings"], log.rig.camera.model()
    rows = [log.world.points.index[name] for name in stream.point]
    far = []
    for t, p, u, v in zip(stream.t, log.world.points.positions[rows], stream.u, stream.v, strict=True):
        uv, _ = reprojection.predict(model, log.reference.at(np.array((t,)))[0], p[None])
        far.append(np.hypot(*(uv[0] - (u, v))) > 6.0 * model.sigma)
    # six standard deviations of the share
    assert abs(np.mean(far) - 0.4) < 6.0 * np.sqrt(0.24 / len(far)) + 0.01


def test_stamps_are_by_the_clock_of_the_camera(make):
    plain = make(0, world={"points": 50}).streams["sightings"]
    late = make(0, world={"points": 50}, rig={"camera": {"time_offset": 0.1}})
    np.testing.assert_allclose(late.streams["sightings"].t, plain.t - 0.1, atol=1e-9)
    assert next(late.measurements(("sightings",))).t == pytest.approx(plain.t[0])


def test_drives_of_two_seeds_through_one_world(make):
    first, second = (make(seed, world_seed=7, world={"points": 20}, faults={"misplaced": 0.2}) for seed in (1, 2))
    assert first.world == second.world
    assert first.world == make(7, world={"points": 20}, faults={"misplaced": 0.2}).world
    assert first.reference.poses.tobytes() != second.reference.poses.tobytes()
    assert first.metadata["world_seed"] == "7"


def test_points_need_a_camera():
    with pytest.raises(InputError, match="expected a rig with a camera"):
        preset("warehouse", {"world": {"points": 3}, "rig": {"camera": None}})

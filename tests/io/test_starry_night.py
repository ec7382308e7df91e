"""The reader of a hand-held stereo camera among known points: made-up files, and the recorded one."""

import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from factorgraph_loc.io.readers import load
from factorgraph_loc.sensors.camera.measurement import PixelSightings
from factorgraph_loc.sensors.twist.measurement import Twist
from factors.camera import model as reprojection

FOCAL, CU, CV, BASELINE = 480.0, 320.0, 240.0, 0.24
# a camera that looks back along the vehicle's x axis with the vehicle's z axis down
C_C_V = np.array(((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)))
OFFSET = np.array((-0.02, 0.1, 0.03))
TURNS = np.array(((0.0, 0.0, 0.0), (0.1, -0.2, 0.3), (0.2, -0.3, 0.5)))
PLACES = np.array(((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.2, 0.1, -0.1)))


def fields(**changes):
    """Three rows in which every other point is seen, without noise; ``changes`` replace fields, None leaves one out."""
    rng = np.random.default_rng(5)
    points = np.column_stack((rng.uniform(-4, -2, 20), rng.uniform(-0.7, 0.7, 20), rng.uniform(-0.5, 0.5, 20)))
    y = np.full((4, 3, 20), -1.0)
    for k, (turn, place) in enumerate(zip(TURNS, PLACES, strict=True)):
        to_vehicle = Rotation.from_rotvec(turn).as_matrix().T  # the file's C_vk_i
        p = C_C_V @ ((points - place) @ to_vehicle.T - OFFSET).T
        left = FOCAL * p[:2] / p[2] + np.array(((CU,), (CV,)))
        both = np.stack((left[0], left[1], left[0] - FOCAL * BASELINE / p[2], left[1]))
        seen = np.all((both >= 0.0) & (both < 480.0), axis=0) & (np.arange(20) % 2 == 0)
        y[:, k, seen] = both[:, seen]
    column = np.full((3, 1), 0.01)
    made = {
        "t": np.array([[0.0, 0.1, 0.25]]),
        "theta_vk_i": TURNS.T,
        "r_i_vk_i": PLACES.T,
        "w_vk_vk_i": np.ones((3, 3)),
        "v_vk_vk_i": np.arange(9.0).reshape(3, 3),
        "rho_i_pj_i": points.T,
        "y_k_j": y,
        "C_c_v": C_C_V,
        "rho_v_c_v": OFFSET[:, None],
        "v_var": column,
        "w_var": column,
        "y_var": np.full((4, 1), 4.0),
        "cu": CU,
        "cv": CV,
        "fu": FOCAL,
        "fv": FOCAL,
        "b": BASELINE,
    }
    return {name: value for name, value in {**made, **changes}.items() if value is not None}


def with_value(name, index, value):
    array = np.array(fields()[name], dtype=float)
    array[index] = value
    return {name: array}


@pytest.fixture
def read(tmp_path, one):
    def call(**changes):
        savemat(tmp_path / "small.mat", fields(**changes))
        return one(tmp_path / "small.mat", reader="starry_night")

    return call


def test_both_cameras_project_the_points_to_where_they_are_seen(read):
    log = read()
    for sensor, settings in (("sightings", log.rig.camera), ("sightings_right", log.rig.camera_right)):
        stream, model = log.streams[sensor], settings.model()
        assert len(stream.t) > 10
        for t, name, u, v in zip(stream.t, stream.point, stream.u, stream.v, strict=True):
            pose = log.reference3.at(np.array([t]))
            position = pose.positions[0] + pose.rotations[0] @ model.position
            point = log.world.points.positions[[log.world.points.index[name]]]
            pixel, *_ = reprojection.linearize_in_space(model, position, pose.rotations[0] @ model.rotation, point)
            np.testing.assert_allclose(pixel[0], (u, v), atol=1e-6)


def test_motion_comes_first_and_cameras_are_told_apart(read):
    log = read()
    first, *seen = [m for m in log.measurements(log.rig.sensors) if m.t == 0.0]
    assert isinstance(first, Twist)
    np.testing.assert_array_equal(first.v, (0.0, 3.0, 6.0))
    assert [(type(m), m.right) for m in seen] == [(PixelSightings, False), (PixelSightings, True)]
    assert log.reference is None
    assert log.rig.twist.shift == pytest.approx(3 * (np.sqrt(0.01 * 0.125),))
    assert log.rig.camera.pixel_sigma == pytest.approx(2.0)


BAD = {
    "field missing": ({"C_c_v": None}, "C_c_v is missing"),
    "a point short": ({"rho_i_pj_i": np.zeros((3, 19))}, "rho_i_pj_i has shape (3, 19), expected numbers in 3 x 20"),
    "lengths differ": ({"v_vk_vk_i": np.zeros((3, 2))}, "v_vk_vk_i has 2 columns, expected 3"),
    "nan": (with_value("r_i_vk_i", (1, 2), np.nan), ":3: r_i_vk_i is nan"),
    "time going back": ({"t": np.array([[0.0, 0.2, 0.1]])}, ":3: time"),
    "outside of the image": (with_value("y_k_j", (1, 1, 0), 999.0), ":2: y_k_j of point 1 is 999.0"),
    "half seen": (with_value("y_k_j", (3, 1, 0), -1.0), ":2: y_k_j of point 1"),
    "no rotation": ({"C_c_v": 2.0 * C_C_V}, "C_c_v is not a rotation"),
    "no focal length": ({"fu": 0.0}, "expected more than 0"),
    "a focal length that no lens has": ({"fu": 1e-6}, "fx is 1e-06"),
    "noise of velocities that is no noise": ({"w_var": np.full((3, 1), 1e12)}, "turn"),
    "no noise": ({"y_var": np.zeros((4, 1))}, "y_var is 0.0"),
}


@pytest.mark.parametrize(("changes", "fragment"), BAD.values(), ids=list(BAD))
def test_bad_starry_night(tmp_path, refused, changes, fragment):
    savemat(tmp_path / "small.mat", fields(**changes))
    refused(tmp_path / "small.mat", "small.mat", fragment, reader="starry_night")


def test_recorded_starry_night(data_root):
    (log,) = load("starry_night", data_root=data_root)
    stream, model = log.streams["sightings"], log.rig.camera.model()
    poses, row = log.reference3, np.searchsorted(log.reference3.t, stream.t)
    points = log.world.points.positions[[log.world.points.index[name] for name in stream.point]]
    error = []
    seen = zip(poses.positions[row], poses.rotations[row], points, stream.u, stream.v, strict=True)
    for position, rotation, point, u, v in seen:
        camera = position + rotation @ model.position
        pixel, *_ = reprojection.linearize_in_space(model, camera, rotation @ model.rotation, point[None])
        error.append(pixel[0] - (u, v))
    assert (len(log.streams["twist"].t), len(stream.t)) == (1900, 9410)
    np.testing.assert_allclose(np.median(np.abs(error), axis=0), (3.27, 6.96), atol=0.02)

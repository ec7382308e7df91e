"""Lens and mounting of a camera chain of Kalibr in a first rig."""

import json
import math

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusal import refusal
from scipy.spatial.transform import Rotation

from factorgraph_loc import new_rig
from factors.camera.model import FORWARD, mounting

LENS = {
    "camera_model": "pinhole",
    "intrinsics": [458.654, 457.296, 367.215, 248.375],
    "distortion_model": "radtan",
    "distortion_coeffs": [-0.28, 0.07, 0.0002, 1.7e-05],
    "resolution": [752, 480],
    "rostopic": "/cam0/image_raw",
    "cam_overlaps": [1],
}
EQUIDISTANT = LENS | {"distortion_model": "equidistant", "distortion_coeffs": [-0.01, 0.01, -0.005, 0.001]}


def rig_of(folder, chain, name=""):
    (folder / "chain.yaml").write_text("%YAML:1.0\n" + yaml.safe_dump(json.loads(json.dumps(chain))))
    return new_rig(camera=f"{folder / 'chain.yaml'}{name}", out=folder / "a.rig.toml", overwrite=True)


def pose(seed):
    rng = np.random.default_rng(seed)
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.uniform(-1.0, 1.0, 3)
    return out


def mounted(camera):
    """The pose (4, 4) of the camera of a rig on the robot."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = mounting(camera.roll, camera.pitch, camera.yaw), (camera.x, camera.y, camera.z)
    return out


def test_the_lens_without_a_mounting(tmp_path):
    camera = rig_of(tmp_path, {"cam0": LENS}).camera
    assert (camera.width, camera.height, camera.distortion_model) == (752, 480, "plumb_bob")
    assert [camera.fx, camera.fy, camera.cx, camera.cy] == LENS["intrinsics"]
    assert list(camera.distortion) == LENS["distortion_coeffs"]
    text = (tmp_path / "a.rig.toml").read_text()
    assert "cam0 of chain.yaml has no mounting on the robot: set x, y, z, roll, pitch and yaw in [camera]" in text
    assert "/cam0/image_raw" in text


def test_a_camera_that_looks_forward(tmp_path):
    on_imu = np.eye(4)
    on_imu[:3, :3], on_imu[:3, 3] = FORWARD, (0.1, 0.0, 0.5)
    chain = {"cam0": EQUIDISTANT | {"T_cam_imu": np.linalg.inv(on_imu).tolist(), "timeshift_cam_imu": 0.0125}}
    camera = rig_of(tmp_path, chain).camera
    assert camera.distortion_model == "equidistant"
    np.testing.assert_allclose((camera.x, camera.y, camera.z), (0.1, 0.0, 0.5), atol=1e-12)
    np.testing.assert_allclose((camera.roll, camera.pitch, camera.yaw), 0.0, atol=1e-12)
    assert "time_offset = 0.0125" in (tmp_path / "a.rig.toml").read_text()


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(seed=st.integers(0, 10_000), is_inverse=st.booleans())
def test_the_mounting_of_a_later_camera(tmp_path, seed, is_inverse):
    on_imu, step = pose(seed), pose(seed + 1)
    known = {"T_imu_cam": on_imu.tolist()} if is_inverse else {"T_cam_imu": np.linalg.inv(on_imu).tolist()}
    chain = {"cam0": LENS | known, "cam1": EQUIDISTANT | {"T_cn_cnm1": step.tolist()}}
    np.testing.assert_allclose(mounted(rig_of(tmp_path, chain, ":cam0").camera), on_imu, atol=1e-6)
    np.testing.assert_allclose(
        mounted(rig_of(tmp_path, chain, ":cam1").camera), on_imu @ np.linalg.inv(step), atol=1e-6
    )


@pytest.mark.parametrize(
    ("changes", "name", "words"),
    [
        ({"camera_model": "omni"}, "", ("cam0.camera_model is 'omni', expected pinhole",)),
        (
            {"distortion_model": "fov"},
            "",
            ("cam0.distortion_model is 'fov', expected one of radtan, equidistant, none",),
        ),
        ({"intrinsics": [1.0, 2.0]}, "", ("cam0.intrinsics is [1.0, 2.0], expected 4 numbers",)),
        ({"distortion_coeffs": [0.1]}, "", ("cam0.distortion_coeffs is [0.1], expected 4 numbers",)),
        ({"T_cam_imu": np.diag((1.0, 1.0, 2.0, 1.0)).tolist()}, "", ("cam0.T_cam_imu", "a rotation and a translation")),
        ({"T_cam_imu": [[1.0]]}, "", ("cam0", "T_cam_imu")),
        ({"intrinsics": [math.nan] * 4}, "", ("cam0", "intrinsics")),
        ({}, ":cam7", ("has no camera 'cam7': did you mean cam0?",)),
    ],
)
def test_what_is_refused(tmp_path, changes, name, words):
    refusal(lambda: rig_of(tmp_path, {"cam0": LENS | changes}, name), "chain.yaml", *words)


def test_several_cameras_and_none(tmp_path):
    refusal(lambda: rig_of(tmp_path, {"cam0": LENS, "cam1": LENS}), "has the cameras cam0, cam1: name one of them")
    refusal(lambda: rig_of(tmp_path, {"imu0": {"rate": 200}}), "has no camera with intrinsics")


def test_a_lens_without_distortion(tmp_path):
    assert not any(rig_of(tmp_path, {"cam0": LENS | {"distortion_model": "none"}}).camera.distortion)

"""Folders of EuRoC, TUM RGB-D and KITTI odometry: what a camera saw, and where it truly was."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.inertial.settings import InertialSettings
from factors.camera import model as reprojection

SENSOR = """\
#Default imu sensor yaml file
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
T_BS = np.array(
    (
        (0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975),
        (0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768),
        (-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949),
        (0.0, 0.0, 0.0, 1.0),
    )
)
TURN = Rotation.from_euler("zyx", (0.3, -0.2, 0.1))
STATES = ("1403636579763555584", "1403636579813555456")


def image(path, size=(32, 24)):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", size).save(path)


@pytest.fixture
def euroc(tmp_path):
    folder = tmp_path / "MH_01" / "mav0"
    for stamp in STATES:
        image(folder / "cam0" / "data" / f"{stamp}.png")
    rows = "".join(f"{stamp},{stamp}.png\n" for stamp in STATES)
    (folder / "cam0" / "data.csv").write_text(f"#timestamp [ns],filename\n{rows}")
    (folder / "cam0" / "sensor.yaml").write_text(SENSOR)
    truth = folder / "state_groundtruth_estimate0"
    truth.mkdir()
    x, y, z, w = TURN.as_quat()
    states = "".join(f"{stamp},1.5,-2.5,0.5,{w},{x},{y},{z}\n" for stamp in STATES)
    header = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
    (truth / "data.csv").write_text(header + states)
    return folder.parent


UNIT = """\
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, 0.1, 1.0, 0.0, 0.0, -0.2, 0.0, 0.0, 1.0, 0.05, 0.0, 0.0, 0.0, 1.0]
rate_hz: 200
gyroscope_noise_density: 1.6968e-04     # [ rad / s / sqrt(Hz) ]
gyroscope_random_walk: 1.9393e-05       # [ rad / s^2 / sqrt(Hz) ]
accelerometer_noise_density: 2.0000e-3  # [ m / s^2 / sqrt(Hz) ]
accelerometer_random_walk: 3.0000e-3    # [ m / s^3 / sqrt(Hz) ]
"""


@pytest.fixture
def flown(euroc):
    """The folder with an inertial unit, which is turned left by a quarter."""
    unit = euroc / "mav0" / "imu0"
    unit.mkdir()
    (unit / "sensor.yaml").write_text(UNIT)
    rows = "".join(f"{int(STATES[0]) + 5_000_000 * i},0.1,0.2,{0.3 + i},1.0,2.0,9.5\n" for i in range(-1, 3))
    header = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y,w_RS_S_z,a_RS_S_x [m s^-2],a_RS_S_y,a_RS_S_z\n"
    (unit / "data.csv").write_text(header + rows)
    return euroc


@pytest.fixture
def tum_rgbd(tmp_path):
    folder = tmp_path / "desk"
    for name in ("1305031102.175304", "1305031102.211214"):
        image(folder / "rgb" / f"{name}.png")
    (folder / "rgb.txt").write_text(
        "# color images\n# timestamp filename\n1305031102.175304 rgb/1305031102.175304.png\n"
        "1305031102.211214 rgb/1305031102.211214.png\n1305031102.3 rgb/gone.png\n"
    )
    x, y, z, w = TURN.as_quat()
    (folder / "groundtruth.txt").write_text(
        f"# ground truth trajectory\n1305031102.1553 1.5 -2.5 0.5 {x} {y} {z} {w}\n1305031102.2553 1.5 -2.5 0.5 {x} {y} {z} {w}\n"
    )
    return folder


@pytest.fixture
def kitti_odometry(tmp_path):
    folder = tmp_path / "dataset"
    sequence = folder / "sequences" / "03"
    for i in range(2):
        image(sequence / "image_2" / f"{i:06d}.png")
    (sequence / "times.txt").write_text("0.000000e+00\n1.036224e-01\n")
    (sequence / "calib.txt").write_text(
        "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP2: 700 0 600 42 0 700 180 0.7 0 0 1 0.001\n"
    )
    (folder / "poses").mkdir()
    # camera axes: one ahead, then 2 m ahead, 1 m to the right and turned right by a quarter
    (folder / "poses" / "03.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n0 0 1 1 0 1 0 0 -1 0 0 2\n")
    return folder


def in_camera(log: Log, points: np.ndarray, row: int = 0) -> np.ndarray:
    """Points (N, 3) of the world in the camera's axes at a row of the reference."""
    camera, true = log.rig.camera.model(), log.reference3
    on_robot = (points - true.positions[row]) @ true.rotations[row]
    return (on_robot - camera.position) @ camera.rotation


def test_euroc_places_the_camera_as_its_calibration_does(euroc, one):
    log = one(euroc, reader="euroc")
    assert [file.name for file in log.streams["camera"].file] == [f"{stamp}.png" for stamp in STATES]
    np.testing.assert_allclose(log.streams["camera"].t, (0.0, 0.049999872), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(log.reference3.t, log.streams["camera"].t)
    assert log.t0_ns == int(STATES[0])
    points = np.array(((3.0, 1.0, 2.0), (-1.0, 4.0, 0.0)))
    body = np.eye(4)
    body[:3, :3], body[:3, 3] = TURN.as_matrix(), (1.5, -2.5, 0.5)
    expected = (np.linalg.inv(body @ T_BS) @ np.column_stack((points, np.ones(2))).T).T[:, :3]
    np.testing.assert_allclose(in_camera(log, points), expected, atol=1e-9)
    assert (log.rig.camera.width, log.rig.camera.fy, log.rig.camera.distortion[3]) == (752, 457.296, 1.76187114e-05)


def test_euroc_has_an_inertial_unit(flown, one):
    log = one(flown, reader="euroc")
    rows, unit = log.streams["inertial"], log.rig.find(InertialSettings)
    np.testing.assert_allclose(rows.t, (-0.005, 0.0, 0.005, 0.01), atol=1e-12)
    np.testing.assert_allclose((rows.ax, rows.ay, rows.az), np.tile(((1.0,), (2.0,), (9.5,)), 4))
    np.testing.assert_allclose((rows.wx, rows.wy, rows.wz - np.arange(-1, 3)), np.tile(((0.1,), (0.2,), (0.3,)), 4))
    np.testing.assert_allclose((unit.x, unit.y, unit.z, unit.roll, unit.pitch), (0.1, -0.2, 0.05, 0.0, 0.0), atol=1e-12)
    assert unit.yaw == pytest.approx(np.pi / 2)
    np.testing.assert_allclose((unit.force_noise, unit.turn_noise), (2e-2, 1.6968e-3))  # ten times that at rest
    assert (unit.force_walk, unit.turn_walk) == (3e-3, 1.9393e-5)
    assert log.rig.sensors == ("camera", "inertial")
    assert "not read" not in log.metadata


def test_tum_poses_are_those_of_the_camera(tum_rgbd, one):
    log = one(tum_rgbd, reader="tum_rgbd")
    assert len(log.streams["camera"].t) == 2
    assert any("1 of 3 images are missing" in line and "rgb/gone.png" in line for line in log.warnings)
    np.testing.assert_allclose(log.reference3.t, (-0.020004, 0.079996), atol=1e-9)
    ahead = np.array((1.5, -2.5, 0.5)) + TURN.as_matrix()[:, 2] * 3.0  # three metres along the optical axis
    np.testing.assert_allclose(in_camera(log, ahead[None]), ((0.0, 0.0, 3.0),), atol=1e-9)


def test_tum_depths_belong_to_the_nearest_image(tum_rgbd, one):
    assert one(tum_rgbd, reader="tum_rgbd").streams["camera"].depth == [None, None]
    for name in ("1305031102.160407", "1305031102.260000"):
        image(tum_rgbd / "depth" / f"{name}.png")
    (tum_rgbd / "depth.txt").write_text(
        "# depth maps\n1305031102.160407 depth/1305031102.160407.png\n1305031102.260000 depth/1305031102.260000.png\n"
    )
    log = one(tum_rgbd, reader="tum_rgbd")
    assert log.streams["camera"].depth == [tum_rgbd / "depth" / "1305031102.160407.png", None]  # the next is 49 ms away
    assert log.rig.camera.depth.unit == 1.0 / 5000.0
    assert "not read" not in log.metadata
    assert not any("depth.txt" in warning for warning in log.warnings)
    (tum_rgbd / "depth" / "1305031102.260000.png").unlink()
    (said,) = (w for w in one(tum_rgbd, reader="tum_rgbd").warnings if "depth.txt" in w)
    assert "1 of 2 images are missing and skipped" in said


def test_what_a_fixed_format_has_beside_what_is_read_is_told(euroc, tum_rgbd, kitti_odometry, one):
    assert "not read" not in one(euroc, reader="euroc").metadata
    (euroc / "mav0" / "imu0").mkdir()
    truth = euroc / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    header, *rows = truth.read_text().splitlines()
    truth.write_text("\n".join([f"{header}, v_RS_R_x [m s^-1]", *(f"{row},0.1" for row in rows)]))
    assert one(euroc, reader="euroc").metadata["not read"] == "imu0, data.csv: v_RS_R_x [m s^-1]"
    assert one(truth).metadata["not read"] == "data.csv: v_RS_R_x [m s^-1]"
    truth.write_text("\n".join(f"{row},0.1" for row in rows))
    assert one(truth).metadata["not read"] == "data.csv: column 9"
    (tum_rgbd / "accelerometer.txt").touch()
    assert one(tum_rgbd, reader="tum_rgbd").metadata["not read"] == "accelerometer.txt"
    image(kitti_odometry / "sequences" / "03" / "image_0" / "000000.png")
    log = one(kitti_odometry, reader="kitti_odometry", options={"sequence": 3, "camera": 2})
    assert log.metadata["not read"] == "image_0"


def test_kitti_cameras_stand_beside_the_first(kitti_odometry, one):
    log = one(kitti_odometry, reader="kitti_odometry", options={"sequence": 3, "camera": 2})
    np.testing.assert_allclose(log.reference3.t, (0.0, 0.1036224), atol=1e-9)
    np.testing.assert_allclose(log.reference3.positions, ((0, 0, 0), (2, -1, 0)), atol=1e-12)
    np.testing.assert_allclose(log.reference3.planar().poses[:, 2], (0.0, -np.pi / 2), atol=1e-12)
    # the projection matrix itself, of a point in the axes of camera 0
    matrix = np.array(((700, 0, 600, 42), (0, 700, 180, 0.7), (0, 0, 1, 0.001)))
    point = np.array((0.5, -0.3, 8.0))
    u, v, depth = matrix @ (*point, 1.0)
    seen = in_camera(log, (reprojection.FORWARD @ point)[None])
    np.testing.assert_allclose(reprojection.project(log.rig.camera.model(), seen)[0], (u / depth, v / depth), atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "file", "change", "fragments"),
    [
        ("euroc", "mav0/cam0/sensor.yaml", ("radial-tangential", "equidistant"), ("sensor.yaml", "'equidistant'")),
        ("euroc", "mav0/cam0/sensor.yaml", ("0.0148655429818", "0.5"), ("sensor.yaml", "T_BS", "a pose")),
        ("euroc", "mav0/cam0/sensor.yaml", ("0.0, 0.0, 0.0, 1.0]", "0.0]"), ("sensor.yaml", "T_BS", "16")),
        ("euroc", "mav0/cam0/sensor.yaml", ("intrinsics:", "intrinsic:"), ("sensor.yaml: intrinsics is missing",)),
        ("euroc", "mav0/cam0/data.csv", (STATES[1] + ",", "soon,"), ("data.csv:3", "'soon'", "a number of ns")),
        ("euroc", "mav0/state_groundtruth_estimate0/data.csv", ("1.5,", "nan,"), ("data.csv:2", "finite")),
        (
            "euroc",
            "mav0/state_groundtruth_estimate0/data.csv",
            ("0.5,", "0.5,2"),
            ("data.csv:2", "quaternion", "expected 1"),
        ),
        ("flown", "mav0/imu0/data.csv", ("1.0,2.0", "1.0,2e9"), ("data.csv:2: 6 is", "m/s^2 in -1000 to 1000")),
        ("flown", "mav0/imu0/data.csv", (",9.5", ""), ("data.csv:2", "column")),
        ("flown", "mav0/imu0/sensor.yaml", ("2.0000e-3", "-1"), ("sensor.yaml", "force_noise")),
        ("flown", "mav0/imu0/sensor.yaml", ("gyroscope_r", "r"), ("sensor.yaml: gyroscope_random_walk is missing",)),
        ("flown", "mav0/imu0/sensor.yaml", ("-1.0,", "-2.0,"), ("sensor.yaml", "T_BS", "a pose")),
        ("tum_rgbd", "rgb.txt", (" rgb/gone.png", ""), ("rgb.txt:5", "2 values")),
        ("tum_rgbd", "rgb.txt", ("rgb/gone.png", "../../etc"), ("rgb.txt:5", "leaves its folder")),
        ("tum_rgbd", "groundtruth.txt", ("1305031102.2553", "1305031101.2553"), ("groundtruth.txt:3", "not before")),
        ("kitti_odometry", "poses/03.txt", ("0 0 1 1", "0 0 2 1"), ("03.txt:2", "orthonormal")),
        ("kitti_odometry", "poses/03.txt", ("-1 0 0 2", "-1 0 0"), ("03.txt:2", "12 values")),
        (
            "kitti_odometry",
            "sequences/03/times.txt",
            ("1.036224e-01\n", ""),
            ("times.txt", "is 1, expected at least 2"),
        ),
        ("kitti_odometry", "sequences/03/times.txt", ("1.036224e-01", "0"), ("times.txt:2", "after that of the row")),
        ("kitti_odometry", "sequences/03/calib.txt", ("P2: 700", "P2: "), ("calib.txt:2", "P2", "12 finite numbers")),
        ("kitti_odometry", "sequences/03/calib.txt", ("P2", "P4"), ("calib.txt: has no line P2",)),
        ("kitti_odometry", "sequences/03/calib.txt", ("0.7 0 0 1", "0.7 0 0 0"), ("calib.txt:2", "P2", "0 0 1")),
        ("kitti_odometry", "sequences/03/calib.txt", ("P2: 700 0", "P2: 700 9"), ("calib.txt:2", "fx 0 cx")),
    ],
)
def test_bad_files(kind, file, change, fragments, refused, request):
    folder = request.getfixturevalue(kind)
    text = (folder / file).read_text()
    assert change[0] in text
    (folder / file).write_text(text.replace(*change, 1))
    options = {"sequence": 3, "camera": 2} if kind == "kitti_odometry" else {}
    refused(folder, *fragments, reader="euroc" if kind == "flown" else kind, options=options)


@pytest.mark.parametrize(
    ("kind", "options", "fragments"),
    [
        ("euroc", {"camera": 1}, ("cam1: does not exist, there are cam0",)),
        ("kitti_odometry", {"sequence": 11}, ("11.txt: does not exist",)),
        ("kitti_odometry", {"sequence": 3, "camera": 1}, ("image_1: holds none of the 2 images",)),
    ],
)
def test_parts_that_are_not_there(kind, options, fragments, refused, request):
    refused(request.getfixturevalue(kind), *fragments, reader=kind, options=options)

"""Fiducial markers found in rendered images, and a robot that finds its place by them."""

import cv2
import numpy as np
import pytest
from drives import driven
from mapped_hall import HEAD, VELOCITIES
from refusal import refusal

import factorgraph_loc as fgloc
from factorgraph_loc import InputError, load
from factorgraph_loc.maps.markers import Marker
from factorgraph_loc.vision.fiducials import find_markers
from factors import se2
from factors.camera import model as reprojection

FAMILIES = {"tag36h11": cv2.aruco.DICT_APRILTAG_36h11, "4x4_50": cv2.aruco.DICT_4X4_50}
CELL, QUIET = 20, 40  # px of a bit of the marker's picture, and of white around it
SCALE = 4  # images are rendered larger and made small by areas


def draw(canvas, family, number, corners):
    """A marker whose corners (4, 2) [px] of the small image are given, onto a canvas that is larger by ``SCALE``."""
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[family])
    side = (dictionary.markerSize + 2) * CELL
    picture = np.full((side + 2 * QUIET, side + 2 * QUIET), 255, np.uint8)
    picture[QUIET:-QUIET, QUIET:-QUIET] = cv2.aruco.generateImageMarker(dictionary, number, side)
    low, high = QUIET - 0.5, QUIET - 0.5 + side  # edges lie between pixels, whose centres are whole numbers
    source = np.array(((low, low), (high, low), (high, high), (low, high)), dtype=np.float32)
    target = ((np.asarray(corners) + 0.5) * SCALE - 0.5).astype(np.float32)
    shape = canvas.shape[::-1]
    warp = cv2.getPerspectiveTransform(source, target)
    drawn = cv2.warpPerspective(picture, warp, shape)
    there = cv2.warpPerspective(np.full_like(picture, 255), warp, shape, flags=cv2.INTER_NEAREST)
    canvas[there > 0] = drawn[there > 0]


def shrunk(canvas, rng):
    small = cv2.resize(canvas, (canvas.shape[1] // SCALE, canvas.shape[0] // SCALE), interpolation=cv2.INTER_AREA)
    return np.clip(small * 0.8 + 20.0 + rng.normal(0.0, 3.0, small.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(("sides", "error"), [((20.0, 30.0), 0.2), ((45.0, 90.0), 0.03)])
def test_corners_are_found_within_a_fraction_of_a_pixel(family, sides, error):
    rng = np.random.default_rng(1)
    errors = []
    for number in range(20):
        turn, half = rng.uniform(-np.pi, np.pi), rng.uniform(*sides) / 2.0
        axes = np.array(((np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))))
        square = np.array(((-1, -1), (1, -1), (1, 1), (-1, 1))) @ axes + rng.uniform(-0.12, 0.12, (4, 2))
        corners = half * square + rng.uniform((90, 80), (230, 160))
        canvas = np.full((240 * SCALE, 320 * SCALE), 180, np.uint8)
        draw(canvas, family, number, corners)
        image = shrunk(canvas, rng)
        found = find_markers(cv2.GaussianBlur(image, (0, 0), 0.8) if number % 2 else image, family)
        assert [name for name, _ in found] in ([number], [])
        errors += [pixels - corners for _, pixels in found]
    assert len(errors) >= 18  # one of a white that is hardly brighter than what is around it may be missed
    assert np.sqrt(np.mean(np.square(errors))) < error
    np.testing.assert_allclose(np.mean(errors, axis=(0, 1)), 0.0, atol=error / 3.0)  # no shift by half a pixel


def test_a_pencil_across_an_edge_does_not_move_the_corners():
    canvas = np.full((240 * SCALE, 320 * SCALE), 180, np.uint8)
    corners = np.array(((100, 60), (180, 60), (180, 140), (100, 140)))
    draw(canvas, "tag36h11", 5, corners)
    image = shrunk(canvas, np.random.default_rng(0))
    image[98:104, 176:200] = 90  # a pencil across an edge
    ((_, found),) = find_markers(image, "tag36h11")
    np.testing.assert_allclose(found, corners, atol=0.3)


def test_a_number_that_is_there_twice_tells_nothing():
    canvas = np.full((240 * SCALE, 320 * SCALE), 180, np.uint8)
    square = np.array(((0, 0), (50, 0), (50, 50), (0, 50)))
    for number, place in ((3, (30, 40)), (3, (220, 40)), (4, (120, 150))):
        draw(canvas, "4x4_50", number, square + place)
    assert [number for number, _ in find_markers(shrunk(canvas, np.random.default_rng(0)), "4x4_50")] == [4]


MARKERS = {
    0: Marker(x=4.0, y=1.0, z=1.2, size=0.4, facing=np.pi),
    1: Marker(x=4.0, y=-0.8, z=0.7, size=0.4, facing=np.pi, roll=0.4),
    2: Marker(x=3.5, y=1.8, z=0.9, size=0.4, facing=-2.2),
    3: Marker(x=3.0, y=0.2, z=1.9, size=0.4, facing=np.pi, pitch=-0.6),
}
RIG = """\
name = "cart"
sensors = ["odometry", "sightings"]
camera = { width = 640, height = 480, fx = 400, fy = 400, cx = 319.5, cy = 239.5, x = 0.1, z = 0.9, pixel_sigma = 0.5 }
"""
MANIFEST = f"""\
rig = "cart.rig.toml"
world = "hall.world.toml"
{HEAD}
[markers]
family = "tag36h11"
{VELOCITIES}
[options.camera]
file = "images.csv"
columns = {{ t = "t", file = "file" }}
units = {{ t = "s" }}

[options.reference]
file = "truth.csv"
columns = {{ t = "t", x = "x", y = "y", heading = "heading" }}
units = {{ t = "s" }}
"""
STEP = np.array((0.05, 0.0, 0.01))  # a tenth of a second at 0.5 m/s


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    """A robot that drives towards four markers; its odometry says that it is a tenth faster, and goes straight."""
    folder = tmp_path_factory.mktemp("hall")
    run = folder / "run"
    run.mkdir()
    (folder / "cart.rig.toml").write_text(RIG)
    rows = [f'"tag36h11-{k}" = {{ {", ".join(f"{key} = {v}" for key, v in m)} }}\n' for k, m in MARKERS.items()]
    (folder / "hall.world.toml").write_text("[markers]\n" + "".join(rows))
    (folder / "hall.toml").write_text(MANIFEST)
    poses = driven(np.tile(se2.exp(STEP), (20, 1)))
    t = np.arange(len(poses)) / 10.0
    (run / "truth.csv").write_text(
        "t,x,y,heading\n" + "".join(f"{a},{x},{y},{h}\n" for a, (x, y, h) in zip(t, poses, strict=True))
    )
    (run / "wheels.csv").write_text("t,v,w\n" + "".join(f"{a},0.55,0.0\n" for a in t))
    (run / "images.csv").write_text("t,file\n" + "".join(f"{t[i]},{i}.png\n" for i in range(0, len(t), 4)))
    camera = fgloc.read_rig(folder / "cart.rig.toml").camera.model()
    rng = np.random.default_rng(0)
    for i in range(0, len(t), 4):
        x, y, heading = poses[i]
        turned = np.array(((np.cos(heading), -np.sin(heading), 0), (np.sin(heading), np.cos(heading), 0), (0, 0, 1)))
        canvas = np.full((480 * SCALE, 640 * SCALE), 180, np.uint8)
        for number, marker in MARKERS.items():
            on_robot = (marker.corners() - (x, y, 0.0)) @ turned
            seen = (on_robot - camera.position) @ camera.rotation
            draw(canvas, "tag36h11", number, reprojection.project(camera, seen))
        cv2.imwrite(str(run / f"{i}.png"), shrunk(canvas, rng))
    return folder / "hall.toml"


def test_a_robot_finds_its_place_by_markers(hall):
    (log,) = load(str(hall))
    seen = log.streams["sightings"]
    assert set(seen.point) == set(log.world.points.names)
    run = fgloc.run(str(hall), "ekf")
    assert run.scores["causal.position_rmse"] < 0.02
    assert run.scores["final.position_rmse"] < 0.005
    blind = fgloc.run(str(hall), "dead_reckoning")
    assert blind.scores["causal.position_rmse"] > 0.07


def test_images_that_are_no_images_and_those_without_markers(hall):

    run = hall.parent / "run"
    broken = hall.parent / "broken.toml"
    (run / "none.csv").write_text("t,file\n0.1,truth.csv\n0.2,0.png\n")
    broken.write_text(MANIFEST.replace("images.csv", "none.csv").replace("tag36h11", "5x5_50"))
    (other,) = load(str(broken))
    assert "sightings" not in other.streams
    warnings = {w.kind: w.fields for w in other.warnings}
    assert warnings["unreadable_images"]["images"] == 1
    assert "truth.csv" in warnings["unreadable_images"]["first"]
    assert warnings["no_markers"] == {"family": "5x5_50", "images": 2}


@pytest.mark.parametrize(
    ("old", "new", "fragment"),
    [
        ('"tag36h11"', '"tag36h12"', "markers.family is 'tag36h12'"),
        ("[options.camera]", "[options.sightings]", "unknown field 'file'"),
    ],
)
def test_wrong_manifests(hall, old, new, fragment):
    wrong = hall.parent / "wrong.toml"
    wrong.write_text(MANIFEST.replace(old, new))
    refusal(lambda: load(str(wrong)), fragment)


def test_markers_need_images(hall):
    wrong = hall.parent / "wrong.toml"
    head, rest = MANIFEST.split("[options.camera]")
    wrong.write_text(head + rest[rest.index("[options.reference]") :])
    with pytest.raises(InputError, match="has no images to detect markers in"):
        load(str(wrong))

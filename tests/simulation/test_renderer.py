"""Rendered images: what a pixel shows, what hides what, and what lens, exposure, noise and motion do to it."""

import dataclasses
import itertools

import cv2
import numpy as np
import pytest

from factorgraph_loc.sensors.rfid.map import Tag
from factorgraph_loc.simulation import preset
from factorgraph_loc.simulation.renderer import ROOM_HEIGHT, Renderer, make_scene
from factorgraph_loc.simulation.settings import ImageSettings
from factorgraph_loc.simulation.worlds import LOWEST_BOX, Plan, make_plan
from factors.camera import model as reprojection

MODEL = preset("office").rig.camera.model()
BARREL = dataclasses.replace(MODEL, distortion=(-0.25, 0.05, 2e-3, -1e-3))
STRAIGHT = dataclasses.replace(MODEL, distortion=(0.0, 0.0, 0.0, 0.0))
WALL = (4.0, 0.0, 4.0, 3.0)  # before the end of the room, one third of it open
BOX = (2.5, 4.0, 3.5, 5.0)
END_WALL = (6.0, 0.0, 6.0, 5.0)
OFFICE = make_plan(preset("office").world, np.random.default_rng(3))


@pytest.fixture(scope="module")
def room():
    """6 x 5 m with one inner wall and one piece of furniture."""
    outline = ((0.0, 0.0, 6.0, 0.0), END_WALL, (6.0, 5.0, 0.0, 5.0), (0.0, 5.0, 0.0, 0.0))
    return make_scene(Plan(6.0, 5.0, (*outline, WALL), (BOX,)), (), np.random.default_rng(0))


@pytest.fixture(scope="module")
def office():
    return make_scene(OFFICE, (), np.random.default_rng(4))


def face_of(scene, segment):
    return int(np.flatnonzero((scene.faces == np.array(segment)).all(axis=1))[0])


def places(count, seed=0):
    """Random cameras, anywhere in the office and turned anyhow, most of them about level."""
    rng = np.random.default_rng(seed)
    for i in range(count):
        position = rng.uniform((0.1, 0.1, 0.2), (19.9, 11.9, LOWEST_BOX))
        angles = rng.uniform(-np.pi, np.pi, 3) * ((0.1, 0.2, 1.0) if i % 3 else (1.0, 1.0, 1.0))
        yield position, reprojection.mounting(*angles)


def brute_force(scene, origin, rays):
    """The nearest point on any face, floor or ceiling that each ray meets, by trying them all."""
    best = np.full(len(rays), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for i, (x1, y1, x2, y2) in enumerate(scene.faces.tolist()):
            along = np.array((x2 - x1, y2 - y1))
            normal = np.array((-along[1], along[0]))
            towards = rays[:, :2] @ normal
            t = (np.array((x1, y1)) - origin[:2]) @ normal / towards
            points = origin + t[:, None] * rays
            share = (points[:, :2] - (x1, y1)) @ along / (along @ along)
            on = (share >= 0.0) & (share <= 1.0) & (points[:, 2] >= scene.bottoms[i]) & (points[:, 2] <= scene.tops[i])
            best = np.where((t > 0.0) & (towards < 0.0) & on & (t < best), t, best)
        levels = [(0.0, 0.0, scene.width, scene.depth, z) for z in (0.0, scene.height)]
        for x1, y1, x2, y2, z in levels:
            t = (z - origin[2]) / rays[:, 2]
            x, y = (origin[:2] + t[:, None] * rays[:, :2]).T
            best = np.where((t > 0.0) & (x >= x1) & (x <= x2) & (y >= y1) & (y <= y2) & (t < best), t, best)
    return origin + best[:, None] * rays


def test_rays_end_where_all_surfaces_tried_one_by_one_say(office):
    renderer = Renderer(office, MODEL)
    pixels = np.random.default_rng(1).uniform((0, 0), (639, 479), (500, 2))
    directions = np.column_stack((reprojection.undistorted(MODEL, pixels), np.ones(len(pixels))))
    for position, rotation in places(5):
        x, y, _ = position
        if any(x1 < x < x2 and y1 < y < y2 for x1, y1, x2, y2 in OFFICE.boxes):
            continue  # in a cupboard
        found = renderer.hits(pixels, position, rotation)
        expected = brute_force(office, position, directions @ rotation.T)
        np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("model", [MODEL, BARREL, STRAIGHT], ids=["rig", "barrel", "straight"])
def test_what_a_pixel_shows_is_seen_at_that_pixel(office, model):
    renderer = Renderer(office, model)
    pixels = np.random.default_rng(2).uniform((0, 0), (639, 479), (400, 2))
    for pose in ((10.0, 6.0, 0.3), (3.0, 6.2, 3.0), (12.0, 2.5, -1.2)):
        points = renderer.hits(pixels, *reprojection.camera_pose(model, np.array(pose)))
        seen, depth = reprojection.predict(model, np.array(pose), points)
        np.testing.assert_allclose(seen, pixels, atol=1e-4)
        assert (depth > 0.0).all()


def painted(scene, segment, colours):
    """The scene with a face in four quarters of grey ``colours`` ((upper left, upper right), (lower left, lower right))."""
    texels = scene.texels.copy()
    for first, width, height in scene.layout[face_of(scene, segment)].tolist():
        rows = np.minimum(np.arange(height) * 2 // height, 1), np.minimum(np.arange(width) * 2 // width, 1)
        picture = np.array(colours, dtype=np.uint8)[rows[0][:, None], rows[1][None]]
        texels[first : first + width * height] = picture.reshape(-1, 1)
    return dataclasses.replace(scene, texels=texels)


@pytest.mark.parametrize("model", [MODEL, BARREL], ids=["rig", "barrel"])
@pytest.mark.parametrize("pose", [(2.0, 1.6, 0.0), (2.6, 1.2, -0.25), (1.2, 2.6, -0.6), (2.5, 2.0, 0.2)])
def test_a_corner_of_a_picture_is_where_the_camera_model_says(room, model, pose):
    """On the inner wall, seen from the front and at a slant, near and far from the middle of the image."""
    face = (4.0, 0.0, 4.0, 3.0)
    scene = painted(room, face, ((200, 40), (40, 200)))
    image = Renderer(scene, model, ImageSettings(vignetting=0.0)).image(
        *reprojection.camera_pose(model, np.array(pose))
    )
    expected, _ = reprojection.predict(model, np.array(pose), np.array(((4.0, 1.5, ROOM_HEIGHT / 2.0),)))
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    start = expected.astype(np.float32).reshape(-1, 1, 2) + np.float32(1.5)
    found = cv2.cornerSubPix(grey, start, (6, 6), (-1, -1), criteria)
    np.testing.assert_allclose(found.reshape(-1, 2), expected, atol=0.25)


def test_pictures_are_not_mirrored(room):
    """What is left of a picture is on the left as one looks at it."""
    scene = painted(room, WALL, ((200, 40), (200, 40)))
    image = Renderer(scene, MODEL).image(*reprojection.camera_pose(MODEL, np.array((2.0, 1.5, 0.0))))
    middle, _ = reprojection.predict(MODEL, np.array((2.0, 1.5, 0.0)), np.array(((4.0, 1.5, 1.0),)))
    u, v = middle[0].astype(int)
    assert image[v, u - 20, 0] > 120 > image[v, u + 20, 0]


def test_noise_has_the_variance_of_the_settings(office):
    """Of some 10^5 values the mean squared error is right to 1 part in 200, by chance; a rounding adds 1/12 twice."""
    settings = ImageSettings(read_noise=2.0, shot_noise=0.1)
    renderer = Renderer(office, MODEL, settings)
    camera = reprojection.camera_pose(MODEL, np.array((10.0, 6.0, 0.3)))
    clean = renderer.image(*camera).astype(float)
    noisy = renderer.image(*camera, rng=np.random.default_rng(0)).astype(float)
    fair = (clean > 40.0) & (clean < 200.0)
    for low, high in itertools.pairwise((40.0, 90.0, 140.0, 200.0)):
        part = fair & (clean >= low) & (clean < high)
        ratio = (noisy - clean)[part] ** 2 / (4.0 + 0.1 * clean[part] + 1.0 / 6.0)
        assert part.sum() > 50_000
        assert ratio.mean() == pytest.approx(1.0, abs=0.03)
        assert abs((noisy - clean)[part].mean()) < 0.1


def test_gain_and_vignetting_change_the_brightness(office):
    camera = reprojection.camera_pose(MODEL, np.array((10.0, 6.0, 0.3)))
    flat, dark = (Renderer(office, MODEL, ImageSettings(vignetting=share)) for share in (0.0, 0.5))
    image = flat.image(*camera).astype(float)
    assert np.abs(flat.image(*camera, gain=0.5) - 0.5 * image).max() <= 1.0
    ratio = (dark.image(*camera).astype(float) + 0.5) / (image + 0.5)
    assert np.median(ratio[:20, :20]) == pytest.approx(0.55, abs=0.06)
    assert np.median(ratio[230:250, 310:330]) == pytest.approx(1.0, abs=0.02)


def edge_width(image):
    """Columns over which a row goes from a tenth to nine tenths of the step in it."""
    row = image[200:280, 200:440, 0].astype(float).mean(axis=0)
    share = (row - row.min()) / (row.max() - row.min())
    return int(((share > 0.1) & (share < 0.9)).sum())


def test_motion_widens_an_edge_by_as_much_as_it_moves(room):
    face = (4.0, 0.0, 4.0, 3.0)
    scene = painted(room, face, ((200, 40), (200, 40)))
    renderer = Renderer(scene, STRAIGHT, ImageSettings(exposure=0.02, vignetting=0.0))
    camera = reprojection.camera_pose(STRAIGHT, np.array((2.0, 1.5, 0.0)))
    still = renderer.image(*camera)
    turning = renderer.image(*camera, turn=np.array((0.0, 0.0, 1.0)))
    moving = renderer.image(*camera, velocity=np.array((0.0, 2.0, 0.0)))
    assert edge_width(still) <= 3
    # 410 px x 0.02 rad, of which 8 tenths count; 410 px x 0.04 m / 1.8 m
    assert edge_width(turning) == pytest.approx(0.8 * 8.2, abs=2.0)
    assert edge_width(moving) == pytest.approx(0.8 * 9.1, abs=2.0)
    # where nothing is to be seen in front of anything, the mean of still images is the same
    angles = np.linspace(-0.01, 0.01, 9)
    shifts = [renderer.image(camera[0], turned(camera[1], angle)).astype(float) for angle in angles]
    assert np.abs(np.mean(shifts, axis=0) - turning).mean() < 1.5


def turned(rotation, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0))) @ rotation


def test_tags_are_seen_where_they_hang():
    plan = Plan(6.0, 5.0, ((0.0, 0.0, 6.0, 0.0), END_WALL, (6.0, 5.0, 0.0, 5.0), (0.0, 5.0, 0.0, 0.0)), ())
    tag = Tag(x=5.98, y=2.0, z=1.2, facing=np.pi)
    with_tag, without = (make_scene(plan, tags, np.random.default_rng(0)) for tags in ((tag,), ()))
    camera = reprojection.camera_pose(STRAIGHT, np.array((4.0, 2.0, 0.0)))
    # each label takes from the generator, so what is drawn after it differs
    first, second = (Renderer(scene, STRAIGHT).image(*camera).astype(int) for scene in (with_tag, without))
    pixel, _ = reprojection.predict(STRAIGHT, np.array((4.0, 2.0, 0.0)), np.array(((6.0, 2.0, 1.2),)))
    u, v = pixel[0].round().astype(int)
    changed = np.abs(first - second).max(axis=2) > 20
    assert changed[v - 2 : v + 3, u - 5 : u + 6].mean() > 0.3


def test_nothing_but_black_is_seen_outside(room):
    renderer = Renderer(room, MODEL)
    camera = reprojection.camera_pose(MODEL, np.array((-9.0, -9.0, np.pi)))
    assert not renderer.image(*camera).any()
    assert np.isnan(renderer.hits(np.array(((320.0, 240.0),)), *camera)).all()

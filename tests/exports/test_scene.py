"""What viewers draw: lights, ellipses, pictures."""

from dataclasses import replace

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from factorgraph_loc import ImageStream, Trajectory
from factorgraph_loc.exports import scene
from factorgraph_loc.sensors.camera import summary as pictures_of


def lights_of(log):
    return {marks.layer: lights for marks, _, lights in scene.layers(log)}


def test_tags_are_lit_from_when_the_antenna_had_them(log):
    lights = lights_of(log)["tags"]
    assert np.allclose(lights.t, [1.0, 1.5, 1.8, 2.0, 2.3, 2.5])
    assert lights.names == (("A",), (), ("A",), ("A", "B"), ("B",), ())


@given(st.lists(st.tuples(st.integers(0, 40), st.sampled_from("abc")), max_size=20))
def test_lights_are_those_of_the_last_half_second(seen):
    lights = scene._lights([k / 8 for k, _ in seen], [name for _, name in seen])
    assert np.all(np.diff(lights.t) > 0.0)
    for k in range(45):
        at = k / 8 + 1 / 16  # between the stamps
        i = np.searchsorted(lights.t, at) - 1
        lit = set(lights.names[i]) if i >= 0 else set()
        assert lit == {name for start, name in seen if start / 8 <= at < start / 8 + scene.LIT_FOR}


def test_an_ellipse_holds_95_percent():
    covariance = np.array(((0.04, 0.03), (0.03, 0.09)))
    (outline,) = scene.outlines(np.array([(1.0, 2.0)]), covariance[None])
    offsets = outline - (1.0, 2.0)
    distance = np.einsum("ki,ij,kj->k", offsets, np.linalg.inv(covariance), offsets)
    assert np.allclose(distance, 5.991, atol=1e-3)  # of chi squared with two degrees of freedom
    assert np.allclose(outline[0], outline[-1])


def test_pictures_become_jpegs(log):
    pictures = list(pictures_of.images(log))
    assert [t for t, _ in pictures] == [0.5, 1.5, 2.5]
    for i, (_, content) in enumerate(pictures):
        picture = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape == (24, 32, 3)
        assert abs(picture.astype(int) - 80 * i).max() <= 2
    jpeg = log.streams["camera"].file[0].with_suffix(".jpg")
    jpeg.write_bytes(pictures[1][1])
    kept = replace(log, streams={"camera": ImageStream(np.zeros(1), [jpeg])})
    assert next(pictures_of.images(kept))[1] == pictures[1][1]


def test_a_path_is_cut_at_gaps():
    t = np.array((0.0, 0.1, 0.2, 5.0, 5.1, 9.0))
    poses = np.column_stack((t, t, t))
    assert [len(part) for part in scene.segments(Trajectory(t, poses))] == [3, 2]

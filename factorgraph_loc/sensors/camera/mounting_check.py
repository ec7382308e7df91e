"""Whether a camera looks as far down as its rig says, by how its images turn with the robot.

A robot that turns by an angle about the vertical rotates a camera by that angle times the vertical part of its optical axis about
that axis, and the image by the opposite: images of a camera that looks at the floor turn as the robot does, those of one that looks
ahead only shift.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from factorgraph_loc.errors import InputError
from factorgraph_loc.model.log import Log
from factorgraph_loc.sensors.camera.settings import CameraSettings
from factorgraph_loc.sensors.camera.stream import ImageStream
from factorgraph_loc.vision.features import extractor
from factorgraph_loc.vision.images import read_image
from factorgraph_loc.vision.matching import match
from factors import se2

PAIRS, FEWEST_PAIRS = 12, 5  # of images that are compared, those between which the robot turns most; fewer tell nothing
TURNS = (0.03, 0.6)  # rad between two images, least and most
FEATURE, COUNT, FEWEST_MATCHES = "orb", 400, 12
APART = 0.5  # difference of the vertical parts of the optical axis that is told


def mounting_problems(log: Log) -> list[str]:
    """A line if the images turn with the robot in another way than the mounting in the rig explains; none without a reference
    with headings, without a camera in the rig, or where too few images tell."""
    stream, camera = log.streams.get("camera"), log.rig.find(CameraSettings)
    if not isinstance(stream, ImageStream) or camera is None or log.reference is None or not log.reference.has_heading:
        return []
    model = camera.model()
    found = [turned / turn for turn, turned in _turns(log, stream)]
    if len(found) < FEWEST_PAIRS:
        return []
    share = float(np.clip(np.median(found), -1.0, 1.0))  # of a camera that looks straight down: 1
    expected = -float(model.rotation[2, 2])
    if abs(share - expected) <= APART:
        return []
    where = "at the floor" if share > APART else "at the ceiling" if share < -APART else "ahead"
    return [
        f"images turn {share:.2f} times as much as the robot, as of a camera that looks {where}, by the rig's mounting "
        f"{expected:.2f} times: is its pitch about {math.asin(share):.1f}, not {camera.pitch:.1f}?"
    ]


def _turns(log: Log, stream: ImageStream) -> Iterator[tuple[float, float]]:
    """How far the robot and the image turn [rad] from one image to the next, where both can be told."""
    assert log.reference is not None
    headings = log.reference.at(stream.t + log.rig.time_offset("camera"))[:, 2]
    turns = se2.wrap(np.diff(headings))
    usable = np.flatnonzero((np.abs(turns) >= TURNS[0]) & (np.abs(turns) <= TURNS[1]))
    for i in sorted(usable[np.argsort(-np.abs(turns[usable]))][:PAIRS].tolist()):
        turned = _turned(stream.file[i : i + 2])
        if turned is not None:
            yield float(turns[i]), turned


def _turned(files: Sequence[Path]) -> float | None:
    """The angle [rad] by which an image is turned against the one before, from right to down, or None if it cannot be told."""
    finder = extractor(FEATURE, COUNT)
    seen = []
    for file in files:
        try:
            seen.append(finder.detectAndCompute(read_image(file)))
        except InputError:
            return None
    (first, of_first), (second, of_second) = seen
    pairs = match(of_first, of_second, binary=finder.binary).indices
    if len(pairs) < FEWEST_MATCHES:
        return None
    before, after = (keypoints.points[pairs[:, k]] for k, keypoints in enumerate((first, second)))
    motion, inliers = cv2.estimateAffinePartial2D(before, after, ransacReprojThreshold=3.0)
    if motion is None or np.count_nonzero(inliers) < FEWEST_MATCHES:
        return None
    return math.atan2(motion[1, 0], motion[0, 0])

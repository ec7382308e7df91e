"""Fiducial markers in images, detected by OpenCV (Garrido-Jurado et al., "Automatic generation and detection of highly reliable
fiducial markers under occlusion", Pattern Recognition 2014; for AprilTags their dictionaries, Olson, ICRA 2011).

Each corner of a marker is a named point at the intersection of lines fitted to the edges. Refinement at the corner itself
(OpenCV's ``cornerSubPix``) is biased: blur moves a corner into the square, so that the marker appears smaller and farther away.
Blur across an edge is symmetric, so that the edge position follows from the mean grey level. (Tabatabai, Mitchell, "Edge location
to subpixel values in digital imagery", PAMI 1984, use moments.)
"""

from collections import Counter

import cv2
import numpy as np

from factorgraph_loc.maps.markers import MarkerFamily
from factorgraph_loc.vision.images import Image
from factors.se2 import Array

REACH = 3.0  # px on both sides of an edge
MIN_REACH = 1.5  # px: a shorter range does not cover a blurred edge
STEP = 0.25  # px between samples across an edge
INSIDE = (0.12, 0.88)  # used part of an edge, without its ends
FARTHEST = 3.0  # px that a corner may move per pass
PASSES = 3  # each uses the lines of the previous one
MIN_CONTRAST = 20.0  # grey levels


def refined_corners(grey: Image, corners: Array, bits: int) -> Array:
    """The refined corners (4, 2) [px] of a marker with ``bits`` along a side, including its black border; unchanged where edges
    are blurred, covered or short."""
    for _ in range(PASSES):
        corners = _met(grey, corners, bits)
    return corners


def _met(grey: Image, corners: Array, bits: int) -> Array:
    """Intersections of the lines fitted near the sides of the square ``corners``."""
    middle = corners.mean(axis=0)
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    reach = min(REACH, 0.8 * float(sides.min()) / bits)  # not across the black border
    if reach < MIN_REACH:
        return corners
    lines = [_line(grey, corners[i], corners[(i + 1) % 4], middle, reach) for i in range(4)]
    out = corners.copy()
    for i in range(4):
        first, second = lines[i - 1], lines[i]
        if first is None or second is None:
            continue
        (normal1, offset1), (normal2, offset2) = first, second
        system = np.stack((normal1, normal2))
        if abs(np.linalg.det(system)) < 0.1:
            continue
        met = np.linalg.solve(system, np.array((offset1, offset2)))
        if np.linalg.norm(met - corners[i]) <= FARTHEST:
            out[i] = met
    return out


def _line(grey: Image, start: Array, end: Array, middle: Array, reach: float) -> tuple[Array, float] | None:
    """The line n.p = c along an edge, with normal n (2,) and c [px]; None if the edge is not visible."""
    along = end - start
    length = float(np.linalg.norm(along))
    normal = np.array((-along[1], along[0])) / length
    normal = normal if normal @ (middle - start) > 0.0 else -normal  # from white to black
    shares = np.linspace(*INSIDE, int(np.clip(length, 8, 60)))
    across = np.arange(-reach, reach + STEP / 2, STEP)
    places = start + shares[:, None] * along
    samples = (places[:, None] + across[:, None] * normal).astype(np.float32)
    # beyond the image border there is no edge
    values = cv2.remap(
        grey, samples[:, :, 0], samples[:, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    ).astype(float)
    white, black = values[:, :2].mean(axis=1), values[:, -2:].mean(axis=1)
    contrast = white - black
    if np.median(contrast) < MIN_CONTRAST:
        return None
    use = contrast > 0.7 * np.median(contrast)
    share = np.clip((values[use] - black[use, None]) / contrast[use, None], 0.0, 1.0)
    weights = np.full(len(across), STEP)
    weights[[0, -1]] = STEP / 2.0
    shift = across[0] + share @ weights
    points = places[use] + shift[:, None] * normal
    for _ in range(2):  # the second time without outliers, such as a shadow or an occlusion
        centre = points.mean(axis=0)
        direction = np.linalg.svd(points - centre, full_matrices=False)[2][0]
        fitted = np.array((-direction[1], direction[0]))
        off = np.abs((points - centre) @ fitted)
        keep = off <= max(3.0 * float(np.median(off)), 0.1)
        if np.count_nonzero(keep) < 4:
            return None
        points = points[keep]
    return fitted, float(fitted @ centre)


def find_markers(image: Image, family: MarkerFamily) -> list[tuple[int, Array]]:
    """The numbers of the markers in an image, and their corners (4, 2) [px]: upper left, upper right, lower right, lower left of
    the printed marker. A number that occurs twice is omitted."""
    grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    detector = _detector(family)
    corners, numbers, _ = detector.detectMarkers(grey)
    bits = detector.getDictionary().markerSize + 2
    detected = [] if numbers is None else [int(number) for number in np.ravel(numbers)]
    count = Counter(detected)
    pairs = zip(detected, corners, strict=True)
    return [
        (number, refined_corners(grey, np.asarray(corner_pixels, dtype=float).reshape(4, 2), bits))
        for number, corner_pixels in pairs
        if count[number] == 1
    ]


def _detector(family: MarkerFamily) -> cv2.aruco.ArucoDetector:
    name = f"DICT_{family.upper()}" if not family.startswith("tag") else f"DICT_APRILTAG_{family[3:].upper()}"
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)), parameters)

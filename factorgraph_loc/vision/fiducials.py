"""Detection of fiducial markers in images, with corners of subpixel accuracy.

OpenCV detects the markers (Garrido-Jurado et al., "Automatic generation and detection of highly reliable fiducial
markers under occlusion", Pattern Recognition 2014). For AprilTags it uses their dictionaries (Olson, ICRA 2011). A
corner is then refined as the intersection of lines fitted to the edges of the marker. Refinement at the corner itself
(OpenCV's ``cornerSubPix``) is biased: blur moves a corner into the square, so that the marker appears smaller and
farther away. Blur across an edge is symmetric, so that the mean grey level determines the position of the edge.
(Tabatabai, Mitchell, "Edge location to subpixel values in digital imagery", PAMI 1984, use moments.)
"""

from collections import Counter

import cv2
import numpy as np

from factorgraph_loc.maps.markers import MarkerFamily
from factorgraph_loc.vision.images import Image
from factors.se2 import Array

REACH = 3.0  # px: an edge is searched within this distance of its previous position
MIN_REACH = 1.5  # px: least search distance; a shorter one does not cover a blurred edge
STEP = 0.25  # px between samples across an edge
INSIDE = (0.12, 0.88)  # fractions of an edge's length between which it is sampled: not near the corners
FARTHEST = 3.0  # px: largest shift of a corner per iteration
PASSES = 3  # iterations; each starts at the corners of the previous one
MIN_CONTRAST = 20.0  # grey levels across an edge; an edge with less contrast is not used


def refined_corners(grey: Image, corners: Array, bits: int) -> Array:
    """Return the corners (4, 2) [px] of a marker, refined to subpixels. Corners at faint or short edges are unchanged.

    ``corners`` (4, 2) [px]: the detected corners. ``bits``: number of cells along a side of the marker, including the
    black border.
    """
    for _ in range(PASSES):
        corners = _intersections(grey, corners, bits)
    return corners


def _intersections(grey: Image, corners: Array, bits: int) -> Array:
    """Return the corners (4, 2) [px] of a marker. They are intersections of lines that are fitted to the edges near the
    sides of the square ``corners`` (4, 2)."""
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
    """Return the line n.p = c along an edge of a marker: the normal n (2,) and c [px]. None if the edge is not visible.

    ``start``, ``end`` (2,) [px]: the ends of the edge. ``middle`` (2,) [px]: the centre of the marker. ``reach`` [px]:
    the largest distance of samples from the line between ``start`` and ``end``.
    """
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
    for _ in range(2):  # the second fit leaves out outliers, such as those of a shadow or an occlusion
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
    """Return (number, corners) of each fiducial marker of a ``family`` that is detected in an image.

    ``corners`` (4, 2) [px]: upper left, upper right, lower right, lower left of the printed marker. Markers with the
    same number in one image are omitted, because at most one of them can be genuine.
    """
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

"""Fiducial markers in images, found by OpenCV (Garrido-Jurado et al., "Automatic generation and detection of highly reliable
fiducial markers under occlusion", Pattern Recognition 2014; for AprilTags their dictionaries, Olson, ICRA 2011).

Each corner of a marker is a point with a name, so that nothing but the reprojection of points is needed to use it. Where exactly
it is, is found by :mod:`factorgraph_loc.vision.marker_corners`.
"""

from collections import Counter

import cv2
import numpy as np

from factorgraph_loc.maps.markers import MarkerFamily
from factorgraph_loc.vision.images import Image
from factorgraph_loc.vision.marker_corners import refined_corners
from factors.se2 import Array


def find_markers(image: Image, family: MarkerFamily) -> list[tuple[int, Array]]:
    """The numbers of the markers in an image, and their corners (4, 2) [px]: upper left, upper right, lower right, lower left of
    the marker as it is printed. Of a number that is there twice neither is given."""
    grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    detector = _detector(family)
    corners, numbers, _ = detector.detectMarkers(grey)
    bits = detector.getDictionary().markerSize + 2
    found = [] if numbers is None else [int(number) for number in np.ravel(numbers)]
    count = Counter(found)
    pairs = zip(found, corners, strict=True)
    return [
        (number, refined_corners(grey, np.asarray(seen, dtype=float).reshape(4, 2), bits))
        for number, seen in pairs
        if count[number] == 1
    ]


def _detector(family: MarkerFamily) -> cv2.aruco.ArucoDetector:
    name = f"DICT_{family.upper()}" if not family.startswith("tag") else f"DICT_APRILTAG_{family[3:].upper()}"
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)), parameters)

"""Benchmark of localization by a camera: the sections of docs/camera-results.md."""

from camera_benchmark import faults, office, sevenscenes, slam, speed

SECTIONS = {
    "office": office.section,
    "slam": slam.section,
    "speed": speed.section,
    "faults": faults.section,
    "sevenscenes": sevenscenes.section,
}

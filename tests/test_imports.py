"""Imports run downwards: no package imports one that stands above it, none imports another in a circle, no estimator a sensor.

``EXCEPTIONS`` are imports that still do: whoever removes one takes it off the list, and nothing is put onto it.
"""

import ast
from collections import defaultdict
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
# from the ground up; packages of one layer may import one another, but not in a circle
LAYERS = (
    ("factors", "errors", "text", "version", "threads", "processes", "drawing"),
    ("files",),
    ("maps",),
    ("model", "vision"),
    ("fitting",),
    ("sensors",),
    ("io", "evaluation", "calibration", "fusion"),
    ("exports", "simulation", "mapping", "slam"),
    ("planning",),
    ("experiments", "live"),
    ("api", "cli", "old_places", ""),
)
EXCEPTIONS = {
    ("factorgraph_loc.fusion.graph_builder", "factorgraph_loc.slam.frame_pairs"),
    ("factorgraph_loc.fusion.graph_builder", "factorgraph_loc.slam.unknown_points"),
    ("factorgraph_loc.fusion.keyframes", "factorgraph_loc.slam.new_points"),
    ("factorgraph_loc.fusion.keyframes", "factorgraph_loc.slam.unknown_points"),
    ("factorgraph_loc.fusion.registry", "factorgraph_loc.slam.monoslam"),
    ("factorgraph_loc.fusion.registry", "factorgraph_loc.slam.space_batch"),
    ("factorgraph_loc.fusion.relocating", "factorgraph_loc.slam.new_points"),
    ("factorgraph_loc.fusion.smoother", "factorgraph_loc.slam.unknown_points"),
    ("factorgraph_loc.model.log", "factorgraph_loc.sensors.odometry.stream"),
    ("factorgraph_loc.model.measurement", "factorgraph_loc.sensors.camera.measurement"),
    ("factorgraph_loc.model.measurement", "factorgraph_loc.sensors.landmarks.measurement"),
    ("factorgraph_loc.model.measurement", "factorgraph_loc.sensors.odometry.measurement"),
    ("factorgraph_loc.model.measurement", "factorgraph_loc.sensors.rfid.measurement"),
    ("factorgraph_loc.model.measurement", "factorgraph_loc.sensors.twist.measurement"),
    ("factorgraph_loc.model.rig", "factorgraph_loc.sensors.camera.settings"),
    ("factorgraph_loc.model.rig", "factorgraph_loc.sensors.landmarks.settings"),
    ("factorgraph_loc.model.rig", "factorgraph_loc.sensors.odometry.settings"),
    ("factorgraph_loc.model.rig", "factorgraph_loc.sensors.rfid.settings"),
    ("factorgraph_loc.model.rig", "factorgraph_loc.sensors.twist.settings"),
    ("factorgraph_loc.model.world", "factorgraph_loc.sensors.landmarks.map"),
    ("factorgraph_loc.model.world", "factorgraph_loc.sensors.rfid.map"),
    ("factorgraph_loc.sensors.camera.finder", "factorgraph_loc.fusion.known_position"),
    ("factorgraph_loc.sensors.camera.tracker", "factorgraph_loc.fusion.cloud"),
    ("factorgraph_loc.sensors.camera.tracker", "factorgraph_loc.fusion.known_position"),
    ("factorgraph_loc.sensors.landmarks.finder", "factorgraph_loc.fusion.known_position"),
    ("factorgraph_loc.sensors.landmarks.forecast", "factorgraph_loc.planning.sensors"),
    ("factorgraph_loc.sensors.landmarks.window", "factorgraph_loc.fusion.known_position"),
    ("factorgraph_loc.sensors.rfid.tracker", "factorgraph_loc.fusion.cloud"),
    ("factorgraph_loc.sensors.rfid.tracker", "factorgraph_loc.fusion.known_position"),
    ("factorgraph_loc.sensors.rfid.tracker", "factorgraph_loc.fusion.scan_finder"),
}

# a module of factorgraph_loc.fusion, and what it knows of a sensor
SENSORS_OF_FUSION = {
    ("dead_reckoning", "factorgraph_loc.sensors.landmarks.measurement"),
    ("ekf", "factorgraph_loc.sensors.camera.finder"),
    ("ekf", "factorgraph_loc.sensors.camera.measurement"),
    ("ekf", "factorgraph_loc.sensors.camera.sensor"),
    ("ekf", "factorgraph_loc.sensors.landmarks.measurement"),
    ("ekf", "factorgraph_loc.sensors.landmarks.pending"),
    ("ekf", "factorgraph_loc.sensors.landmarks.sensor"),
    ("ekf", "factorgraph_loc.vision.frame"),
    ("ekf", "factors.camera.factor"),
    ("ekf", "factors.landmarks.factor"),
    ("ekf", "factors.landmarks.model"),
    ("ekf", "factors.odometry.model"),
    ("graph_builder", "factorgraph_loc.sensors.camera.measurement"),
    ("graph_builder", "factorgraph_loc.sensors.camera.sensor"),
    ("graph_builder", "factorgraph_loc.sensors.landmarks.measurement"),
    ("graph_builder", "factorgraph_loc.sensors.landmarks.pending"),
    ("graph_builder", "factorgraph_loc.sensors.landmarks.sensor"),
    ("graph_builder", "factorgraph_loc.sensors.rfid.measurement"),
    ("graph_builder", "factorgraph_loc.sensors.rfid.sensor"),
    ("graph_builder", "factors.camera.model"),
    ("graph_builder", "factors.landmarks.factor"),
    ("graph_builder", "factors.landmarks.model"),
    ("graph_builder", "factors.odometry.model"),
    ("graph_builder", "factors.rfid.detection"),
    ("graph_builder", "factors.rfid.factor"),
    ("graph_builder", "factors.rfid.update"),
    ("heading_search", "factorgraph_loc.sensors.camera.finder"),
    ("heading_search", "factorgraph_loc.sensors.landmarks.finder"),
    ("heading_search", "factorgraph_loc.sensors.landmarks.measurement"),
    ("heading_search", "factorgraph_loc.sensors.landmarks.sensor"),
    ("heading_search", "factorgraph_loc.sensors.odometry.motion"),
    ("heading_search", "factorgraph_loc.sensors.rfid.measurement"),
    ("keyframes", "factorgraph_loc.sensors.odometry.motion"),
    ("keyframes", "factors.camera.factor"),
    ("keyframes", "factors.landmarks.factor"),
    ("keyframes", "factors.odometry.kernels"),
    ("keyframes", "factors.odometry.model"),
    ("keyframes", "factors.rfid.factor"),
    ("known_position", "factorgraph_loc.sensors.odometry.motion"),
    ("landmark_tracker", "factorgraph_loc.sensors.landmarks.finder"),
    ("landmark_tracker", "factorgraph_loc.sensors.landmarks.measurement"),
    ("landmark_tracker", "factorgraph_loc.sensors.landmarks.monitor"),
    ("landmark_tracker", "factorgraph_loc.sensors.landmarks.sensor"),
    ("landmark_tracker", "factorgraph_loc.sensors.odometry.motion"),
    ("landmark_tracker", "factors.landmarks.factor"),
    ("landmark_tracker", "factors.landmarks.model"),
    ("particle_filter", "factorgraph_loc.sensors.camera.finder"),
    ("particle_filter", "factorgraph_loc.sensors.camera.sensor"),
    ("particle_filter", "factorgraph_loc.sensors.camera.tracker"),
    ("particle_filter", "factorgraph_loc.sensors.landmarks.measurement"),
    ("particle_filter", "factorgraph_loc.sensors.rfid.measurement"),
    ("particle_filter", "factorgraph_loc.sensors.rfid.monitor"),
    ("particle_filter", "factorgraph_loc.sensors.rfid.tracker"),
    ("particle_filter", "factors.landmarks.model"),
    ("particle_filter", "factors.odometry.model"),
    ("relocating", "factorgraph_loc.sensors.camera.finder"),
    ("relocating", "factorgraph_loc.sensors.camera.sensor"),
    ("relocating", "factorgraph_loc.sensors.landmarks.finder"),
    ("relocating", "factorgraph_loc.sensors.landmarks.monitor"),
    ("relocating", "factorgraph_loc.sensors.landmarks.pending"),
    ("relocating", "factorgraph_loc.sensors.landmarks.sensor"),
    ("relocating", "factorgraph_loc.sensors.rfid.measurement"),
    ("relocating", "factorgraph_loc.sensors.rfid.monitor"),
    ("relocating", "factorgraph_loc.sensors.rfid.tag_map"),
    ("relocating", "factors.landmarks.factor"),
    ("relocating", "factors.rfid.detection"),
    ("relocating", "factors.rfid.update"),
    ("scan_finder", "factorgraph_loc.sensors.odometry.motion"),
    ("scan_finder", "factors.rfid.detection"),
    ("search", "factorgraph_loc.sensors.odometry.motion"),
    ("search", "factors.rfid.detection"),
    ("smoother", "factors.odometry.model"),
    ("switching", "factorgraph_loc.sensors.odometry.motion"),
    ("switching", "factorgraph_loc.sensors.rfid.measurement"),
    ("timeline", "factorgraph_loc.sensors.camera.measurement"),
    ("timeline", "factorgraph_loc.sensors.landmarks.measurement"),
    ("timeline", "factorgraph_loc.sensors.odometry.motion"),
    ("timeline", "factorgraph_loc.sensors.rfid.measurement"),
    ("timeline", "factorgraph_loc.vision.frame"),
}
HEIGHT = {package: height for height, packages in enumerate(LAYERS) for package in packages}
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for folder in ("factorgraph_loc", "factors")
    for path in (ROOT / folder).rglob("*.py")
}


def package(module: str) -> str:
    top, _, below = module.partition(".")
    return top if top == "factors" else below.partition(".")[0]


def imported(module: str, *, at_once: bool = False) -> set[str]:
    """The modules of this project that a module imports, or names in a string; ``at_once``: when it is itself imported."""
    tree = ast.parse(MODULES[module].read_text())
    nodes = ast.walk(tree)
    if at_once:
        nodes = iter(tree.body)
    found: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {m if (m := f"{node.module}.{alias.name}") in MODULES else node.module for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and not at_once:
            found.add(node.value.partition(":")[0])
    return {m for m in found if m in MODULES and m != module}


IMPORTS = {module: imported(module) for module in MODULES}


def test_every_package_has_a_layer():
    assert {package(module) for module in MODULES} == HEIGHT.keys()


def test_no_import_goes_up():
    # what users see of the package stands at the top, and names all that is below
    up = {
        (module, other)
        for module, others in IMPORTS.items()
        for other in others
        if HEIGHT[package(other)] > HEIGHT[package(module)]
    }
    assert up == EXCEPTIONS


def test_no_estimator_imports_a_sensor():
    of_sensors = ("factorgraph_loc.sensors", "factorgraph_loc.vision", "factors.odometry", "factors.landmarks")
    of_sensors += ("factors.rfid", "factors.camera")
    found = {
        (module.removeprefix("factorgraph_loc.fusion."), other)
        for module, others in IMPORTS.items()
        for other in others
        if package(module) == "fusion" and other.startswith(of_sensors)
    }
    assert found == SENSORS_OF_FUSION


def test_no_circle_of_modules():
    graph = {module: imported(module, at_once=True) for module in MODULES}
    assert list(TopologicalSorter(graph).static_order())


def test_no_circle_of_packages():
    graph: dict[str, set[str]] = defaultdict(set)
    for module, others in IMPORTS.items():
        for other in others:
            if (module, other) not in EXCEPTIONS and package(other) != package(module):
                graph[package(module)].add(package(other))
    assert list(TopologicalSorter(graph).static_order())

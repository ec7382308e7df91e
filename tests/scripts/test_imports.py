"""Imports run downwards: no package imports one that stands above it, none imports another in a circle, no estimator a sensor.

``EXCEPTIONS`` are imports that still do: whoever removes one takes it off the list, and nothing is put onto it.
"""

from collections import defaultdict
from graphlib import TopologicalSorter

from package_tables import HEIGHT, MODULES, ROOT, imported, package_of, tables

EXCEPTIONS = {
    ("factorgraph_loc.fusion.graph_builder", "factorgraph_loc.slam.frame_pairs"),
    ("factorgraph_loc.fusion.graph_builder", "factorgraph_loc.slam.unknown_points"),
    ("factorgraph_loc.fusion.keyframes", "factorgraph_loc.slam.new_points"),
    ("factorgraph_loc.fusion.keyframes", "factorgraph_loc.slam.unknown_points"),
    ("factorgraph_loc.fusion.relocating", "factorgraph_loc.slam.new_points"),
    ("factorgraph_loc.fusion.smoother", "factorgraph_loc.slam.unknown_points"),
    ("factorgraph_loc.model.measurement", "factorgraph_loc.sensors.camera.measurement"),
    ("factorgraph_loc.model.measurement", "factorgraph_loc.sensors.landmarks.measurement"),
    ("factorgraph_loc.model.measurement", "factorgraph_loc.sensors.odometry.measurement"),
    ("factorgraph_loc.model.measurement", "factorgraph_loc.sensors.rfid.measurement"),
    ("factorgraph_loc.model.measurement", "factorgraph_loc.sensors.twist.measurement"),
    ("factorgraph_loc.sensors.camera.finder", "factorgraph_loc.fusion.known_position"),
    ("factorgraph_loc.sensors.camera.tracker", "factorgraph_loc.fusion.cloud"),
    ("factorgraph_loc.sensors.camera.tracker", "factorgraph_loc.fusion.known_position"),
    ("factorgraph_loc.sensors.landmarks.finder", "factorgraph_loc.fusion.known_position"),
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
IMPORTS = {module: imported(module) for module in MODULES}


def test_every_package_has_a_layer():
    assert {package_of(module) for module in MODULES} == HEIGHT.keys()


def test_no_import_goes_up():
    # what users see of the package stands at the top, and names all that is below
    up = {
        (module, other)
        for module, others in IMPORTS.items()
        for other in others
        if HEIGHT[package_of(other)] > HEIGHT[package_of(module)]
    }
    assert up == EXCEPTIONS


def test_no_estimator_imports_a_sensor():
    of_sensors = ("factorgraph_loc.sensors", "factorgraph_loc.vision", "factors.odometry", "factors.landmarks")
    of_sensors += ("factors.rfid", "factors.camera")
    found = {
        (module.removeprefix("factorgraph_loc.fusion."), other)
        for module, others in IMPORTS.items()
        for other in others
        if package_of(module) == "fusion" and other.startswith(of_sensors)
    }
    assert found == SENSORS_OF_FUSION


def test_no_circle_of_modules():
    graph = {module: imported(module, at_once=True) for module in MODULES}
    assert list(TopologicalSorter(graph).static_order())


def test_no_circle_of_packages():
    graph: dict[str, set[str]] = defaultdict(set)
    for module, others in IMPORTS.items():
        for other in others:
            if (module, other) not in EXCEPTIONS and package_of(other) != package_of(module):
                graph[package_of(module)].add(package_of(other))
    assert list(TopologicalSorter(graph).static_order())


def test_every_folder_is_a_package():
    # setuptools leaves out folders that are none
    for path in MODULES.values():
        for folder in path.relative_to(ROOT).parents[:-1]:
            assert (ROOT / folder / "__init__.py").is_file(), folder


def test_the_page_of_the_architecture_is_up_to_date():
    page = (ROOT / "docs/architecture.md").read_text()
    assert page.partition("<!-- tables -->\n\n")[2].splitlines() == list(tables()), (
        "scripts/architecture --docs docs/architecture.md"
    )

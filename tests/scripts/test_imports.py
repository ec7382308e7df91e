"""Imports run downwards: no package imports one that stands above it, none imports another in a circle, no estimator a sensor.

``EXCEPTIONS`` are imports that still do: whoever removes one takes it off the list, and nothing is put onto it.
"""

from collections import defaultdict
from graphlib import TopologicalSorter

from package_tables import HEIGHT, MODULES, ROOT, imported, package_of, tables

EXCEPTIONS: set[tuple[str, str]] = set()

# what estimators and sensors know of each other
CONTRACT = {f"factorgraph_loc.sensors.{name}" for name in ("base", "binding", "known_position", "registry")}
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
        (module, other)
        for module, others in IMPORTS.items()
        for other in others - CONTRACT
        if package_of(module) == "fusion" and other.startswith(of_sensors)
    }
    assert not found


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

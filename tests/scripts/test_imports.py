"""Imports run downwards: no package imports one that stands above it, none imports another in a circle, no estimator a sensor,
and none what is inside another: what that does not list as ``__all__``, or what begins with an underscore.

``EXCEPTIONS`` are imports that still do: whoever removes one takes it off the list, and nothing is put onto it.
"""

import importlib
import re
import tomllib
from collections import defaultdict
from graphlib import TopologicalSorter

import pytest
from package_tables import FACES, HEIGHT, MODULES, ROOT, SECTIONS, imported, named, names_in, package_of, steps
from page_tables import with_tables

EXCEPTIONS: set[tuple[str, str]] = set()

# what estimators and sensors know of each other
CONTRACT = {f"factorgraph_loc.sensors.{name}" for name in ("base", "known_position", "motion", "registry")}


@pytest.fixture(scope="module")
def imports():
    """What each module imports."""
    return {module: imported(module) for module in MODULES}


@pytest.fixture(scope="module")
def in_use():
    """What is imported, by whom: by our modules, by the package of another that the docs show, by commands, and by readers of the
    docs."""
    found = {(module, *found) for module in MODULES for found in named(module)}
    found |= {("factorgraph_loc", *found) for found in names_in(ROOT / "factorgraph_loc/__init__.pyi")}
    found |= {("", *found) for found in names_in(ROOT / "docs/adding-a-sensor.md")}
    commands = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"].values()
    found |= {("", *command.split(":")) for command in commands}
    return found | {("", shown, "") for shown in re.findall(r"automodule:: (\S+)", (ROOT / "docs/api.md").read_text())}


def test_every_package_has_a_layer():
    assert {package_of(module) for module in MODULES} == HEIGHT.keys()


def test_no_import_goes_up(imports):
    # what users see of the package stands at the top, and names all that is below
    up = {
        (module, other)
        for module, others in imports.items()
        for other in others
        if HEIGHT[package_of(other)] > HEIGHT[package_of(module)]
    }
    assert up == EXCEPTIONS


def test_nothing_waits_for_the_statistics_of_scipy():
    # their import takes half a second, in each process of a comparison too; scipy.special has what is needed of them
    assert not [
        path for path in MODULES.values() if re.search(r"^ *(from|import) scipy\.stats", path.read_text(), re.M)
    ]


def test_no_estimator_imports_a_sensor(imports):
    of_sensors = ("factorgraph_loc.sensors", "factorgraph_loc.vision", "factors.odometry", "factors.landmarks")
    of_sensors += ("factors.rfid", "factors.camera")
    found = {
        (module, other)
        for module, others in imports.items()
        for other in others - CONTRACT
        if package_of(module) == "fusion" and other.startswith(of_sensors)
    }
    assert not found


def test_no_circle_of_modules():
    graph = {module: imported(module, at_once=True) for module in MODULES}
    assert list(TopologicalSorter(graph).static_order())


def test_no_circle_of_packages(imports):
    graph: dict[str, set[str]] = defaultdict(set)
    for module, others in imports.items():
        for other in others:
            if (module, other) not in EXCEPTIONS and package_of(other) != package_of(module):
                graph[package_of(module)].add(package_of(other))
    assert list(TopologicalSorter(graph).static_order())


def test_no_import_of_the_inside_of_another_package(in_use):
    # whoever needs a module of another package lists it in the `__all__` of its `__init__.py`, if it is not better moved
    inside = {
        (user, f"{package}.{name}")
        for user, *found in in_use
        for package, name in steps(*found, user=user)
        if name not in FACES[package]
    }
    assert not inside


def test_no_import_of_a_private_name(in_use):
    private = {
        (user, place, name)
        for user, place, name in in_use
        if any(part.startswith("_") and part != "__version__" for part in (*place.split("."), *name.split(".")))
        and user.rpartition(".")[0] != place.rpartition(".")[0]
    }
    assert not private


def test_what_is_public_is_there_and_is_used(in_use):
    used = {step for user, *found in in_use for step in steps(*found, user=user)}
    public = {(package, name) for package, face in FACES.items() for name in face}
    modules = {(package, name) for package, name in public if f"{package}.{name}" in MODULES}
    assert modules <= used, "no other package imports these: take them off the `__all__` of their package"
    assert all(hasattr(importlib.import_module(package), name) for package, name in public - modules)


def test_no_two_classes_have_one_name():
    # a reader of a format has its options as a class of this name
    places = defaultdict(list)
    for module, path in MODULES.items():
        for name in re.findall(r"^ *class (\w+)[(:\[]", path.read_text(), re.MULTILINE):
            if name != "Options":
                places[name].append(module)
    assert len(places) > 500  # the pattern finds them
    assert not {name: modules for name, modules in places.items() if len(modules) > 1}


def test_every_folder_is_a_package():
    # setuptools leaves out folders that are none
    for path in MODULES.values():
        for folder in path.relative_to(ROOT).parents[:-1]:
            assert (ROOT / folder / "__init__.py").is_file(), folder


def test_the_page_of_the_architecture_is_up_to_date():
    page = (ROOT / "docs/architecture.md").read_text()
    for section, lines in SECTIONS.items():
        assert page == with_tables(page, lines(), section), "scripts/architecture --docs docs/architecture.md"

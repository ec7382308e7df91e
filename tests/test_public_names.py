"""What scripts import from the package itself: every name is there, is documented, and does its work with nothing else imported."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import factorgraph_loc as fgloc

ROOT = Path(__file__).parents[1]
EXAMPLES = [*sorted((ROOT / "scripts").glob("example_*")), ROOT / "scripts/ros2_node_example"]
DETAILS = re.findall(r"automodule:: (\S+)\n   :members:(.*)", (ROOT / "docs/api.md").read_text())


@pytest.mark.parametrize("name", fgloc.__all__)
def test_every_name_is_there_and_documented(name):
    value = getattr(fgloc, name)
    assert f"`{name}`" in (ROOT / "docs/api.md").read_text().split("## In detail")[0]
    module = getattr(value, "__module__", None)
    if isinstance(value, type) or callable(value):
        assert value.__doc__
        listed = [members for shown, members in DETAILS if module == shown or module.startswith(f"{shown}.")]
        assert any(not members.strip() or name in re.split(r",\s*", members.strip()) for members in listed)


def test_names_cost_nothing_until_they_are_used():
    code = (
        "import sys, factorgraph_loc as fgloc\n"
        "assert set(fgloc.__all__) <= set(dir(fgloc))\n"
        "from factorgraph_loc import InputError\n"
        "assert {'numpy', 'gtsam', 'pydantic', 'polars'}.isdisjoint(sys.modules)\n"
        "from factorgraph_loc import VelocityOdometry\n"
        "assert {'gtsam', 'polars'}.isdisjoint(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_run_on_the_floor_loads_no_optimizers_and_no_rotations_of_scipy(tmp_path):
    fgloc.write_native(fgloc.simulate("office", changes={"drive": {"duration": 4.0}}), tmp_path / "log")
    code = (
        "import sys, factorgraph_loc as fgloc\n"
        "fgloc.run(fgloc.load(sys.argv[1])[0], 'dead_reckoning')\n"
        "assert {'scipy.optimize', 'scipy.spatial', 'matplotlib', 'typer'}.isdisjoint(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, tmp_path / "log"], check=True)


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda script: script.name)
def test_examples_import_from_the_package_alone(script):
    found = re.findall(r"^(?:from|import) ((?:factorgraph_loc|factors)\S*)", script.read_text(), re.MULTILINE)
    assert set(found) == {"factorgraph_loc"}


def test_several_logs_are_not_one():
    both = {"run": "1,2"}
    assert [log.name for log in fgloc.load("plaza2", options=both)] == ["plaza2-run1", "plaza2-run2"]
    with pytest.raises(fgloc.InputError, match="plaza2 refers to 2 logs, expected one: plaza2-run1, plaza2-run2"):
        fgloc.read_log("plaza2", options=both)

"""What scripts import from the package itself: every name is there, is documented, and does its work with nothing else imported."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
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


def made_log():
    """Two seconds along a wall, made by hand."""
    t = np.arange(20) / 10.0
    ones = np.ones(20)
    world = fgloc.World(name="hall", landmarks={"door": fgloc.Landmark(x=3.0, y=1.0)}, tags={"E2": fgloc.Tag(x=1, y=1)})
    rig = fgloc.Rig(name="cart", sensors=["odometry", "bearing_range"])
    streams = {
        "odometry": fgloc.VelocityStream(t, 0.5 * ones, 0.0 * ones),
        "bearing_range": fgloc.BearingRangeStream(
            t, ["door"] * 20, np.hypot(3.0 - 0.5 * t, 1.0), np.arctan2(1.0, 3.0 - 0.5 * t)
        ),
    }
    start = fgloc.StartPose(0.0, np.zeros(3), np.array([0.1, 0.1, 0.05]))
    truth = fgloc.Trajectory(t, np.column_stack((0.5 * t, 0.0 * t, 0.0 * t)))
    return fgloc.Log("hall", rig, world, streams, reference=truth, start=start)


def test_a_script_makes_writes_reads_and_runs_a_log(tmp_path):
    log = made_log()
    fgloc.write_native(log, str(tmp_path / "hall"))
    read = fgloc.read_log(str(tmp_path / "hall"))
    assert read.name == "hall"
    assert read.streams["odometry"].v == pytest.approx(log.streams["odometry"].v)
    fgloc.write_native(log, str(tmp_path / "copy"), format="parquet")
    assert (tmp_path / "copy/odometry.parquet").is_file()
    found = fgloc.run(read, "ekf").result
    assert found.final.poses[-1] == pytest.approx((0.95, 0.0, 0.0), abs=0.1)
    fgloc.write_trajectory(found.final, str(tmp_path / "ekf.tum"))
    read = fgloc.Trajectory.of(fgloc.read_trajectory(str(tmp_path / "ekf.tum")))
    assert read.poses == pytest.approx(found.final.poses, abs=1e-8)


def test_a_script_keeps_rig_map_and_grid(tmp_path):
    log = made_log()
    fgloc.write_rig(log.rig, str(tmp_path / "cart.rig.toml"))
    assert fgloc.read_rig(str(tmp_path / "cart.rig.toml")) == log.rig
    points = fgloc.PointMap.of(["a", "b"], np.array([[1.0, 2.0, 0.5], [2.0, 2.0, 0.5]]))
    fgloc.write_world(log.world.model_copy(update={"points": points}), str(tmp_path / "hall.world.toml"))
    world = fgloc.read_world(str(tmp_path / "hall.world.toml"))
    assert (world.landmarks, world.tags) == (log.world.landmarks, log.world.tags)
    assert world.points.positions == pytest.approx(points.positions)
    shipped = fgloc.read_grid(str(ROOT / "datasets/rfid-aisle.default.npz"))
    fgloc.write_grid(shipped, str(tmp_path / "grid.npz"))
    assert np.array_equal(fgloc.read_grid(tmp_path / "grid.npz").logits, shipped.logits)


def test_several_logs_are_not_one():
    both = {"run": "1,2"}
    assert [log.name for log in fgloc.load("plaza2", options=both)] == ["plaza2-run1", "plaza2-run2"]
    with pytest.raises(fgloc.InputError, match="plaza2 refers to 2 logs, expected one: plaza2-run1, plaza2-run2"):
        fgloc.read_log("plaza2", options=both)

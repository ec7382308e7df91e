"""The examples of live use: the one of the docs, the replay of a log, and the ROS 2 node, with and without ROS."""

import json
import math
import re
import sys
from copy import deepcopy
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import polars as pl
import pytest
from in_short import runs_here  # noqa: F401 - a fixture
from recorded_logs import CONVERTED
from scripts_here import run_script

import factorgraph_loc as fgloc
from factorgraph_loc.evaluation.warned import SIMULATION
from factorgraph_loc.experiments.experiment_file import read_experiment
from factorgraph_loc.files.models import set_key
from factorgraph_loc.files.shipped import manifests
from factorgraph_loc.fusion.registry import settings_of
from factorgraph_loc.simulation import preset

ROOT = Path(__file__).parents[2]
NODE = ROOT / "scripts/ros2_node_example"


@pytest.fixture(scope="module")
def log():
    return fgloc.simulate("office", 3, changes={"drive": {"duration": 20.0}, "world": {"tags": 12, "landmarks": 6}})


@pytest.fixture
def robot(log, tmp_path, monkeypatch):
    """A folder with a robot's rig and map, in which we are."""
    fgloc.write_rig(log.rig, tmp_path / "robot.rig.toml")
    fgloc.write_world(log.world, tmp_path / "hall.world.toml")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("robot")
def test_the_example_of_the_docs_runs(capsys):
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/live.md").read_text(), re.DOTALL)
    exec(compile(example, "live.md", "exec"), {})
    assert re.match(r"100\.3 \[2\.\d+ +1\.\d+ .* localized\n$", capsys.readouterr().out, re.DOTALL)


def test_a_log_is_replayed(log, tmp_path, capsys):
    fgloc.convert(log, tmp_path / "office")
    options = ("--speed", 20, "--every", 5, "--plot", tmp_path / "way.png")
    assert run_script("example_live", tmp_path / "office", *options) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if re.match(r" +\d", line)]
    assert len(rows) >= 2
    assert all(row[6] in ("localized", "ambiguous") and float(row[7]) < 0.5 for row in rows)
    assert (tmp_path / "way.png").stat().st_size > 1000


def test_a_log_that_is_not_there_is_one_line():
    with pytest.raises(SystemExit, match=r"^error: .*nowhere.*$"):
        run_script("example_live", "nowhere")


def test_without_ros_the_node_says_what_it_needs(monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(NODE), "robot.rig.toml", "hall.world.toml"])
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(SystemExit, match=r"this example needs ROS 2 with rclpy, .* scripts/example_live"):
        node_example().main()


@pytest.mark.usefixtures("robot")
def test_the_node_takes_messages_and_sends_poses(log, monkeypatch):
    """With a stand-in for ROS that calls back what the node subscribes to."""
    node = Node()
    for name, members in {
        "rclpy": {"init": lambda **_: None, "create_node": lambda _: node, "spin": drive},
        "geometry_msgs.msg": {"PoseWithCovarianceStamped": Message},
        "nav_msgs.msg": {"Odometry": object},
        "std_msgs.msg": {"String": object},
    }.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    for package in ("geometry_msgs", "nav_msgs", "std_msgs"):
        monkeypatch.setitem(sys.modules, package, ModuleType(package))
    node.tag, node.antenna = next(iter(log.world.tags)), next(iter(log.rig.rfid.all_antennas()))
    monkeypatch.setattr(sys, "argv", [str(NODE), "robot.rig.toml", "hall.world.toml", "--ros-args"])
    node_example().main()
    (sent,) = node.sent
    assert sent.header.stamp.sec + 1e-9 * sent.header.stamp.nanosec == pytest.approx(1.7e9 + 2.0, abs=1e-6)
    position, turn = sent.pose.pose.position, sent.pose.pose.orientation
    assert (position.x, position.y) == pytest.approx((3.0, 2.5), abs=0.2)
    assert 2.0 * math.atan2(turn.z, turn.w) == pytest.approx(math.pi / 2.0, abs=0.1)
    assert np.array(sent.pose.covariance).reshape(6, 6)[0, 0] > 0.0
    assert len(node.warnings) == 1
    assert "v is nan, expected a finite number" in node.warnings[0]


def node_example():
    """The script as a module."""
    loader = SourceFileLoader("ros2_node_example", str(NODE))
    module = module_from_spec(spec_from_loader(loader.name, loader))
    loader.exec_module(module)
    return module


class Message(SimpleNamespace):
    """A message whose fields are there when they are asked for."""

    def __getattr__(self, name):
        setattr(self, name, Message())
        return getattr(self, name)


class Node:
    """What the example uses of a node."""

    def __init__(self):
        self.callbacks, self.sent, self.warnings = {}, [], []

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=self.sent.append)

    def create_subscription(self, kind, topic, callback, depth):
        self.callbacks[topic] = callback

    def create_timer(self, period, callback):
        self.timer = callback

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append)

    def destroy_node(self):
        pass


def drive(node):
    """A start, two seconds of driving by 0.25 m/s, a message that is broken, and reads of a tag; then the timer, as at first."""
    node.timer()
    start = Message()
    start.pose.pose.position.x, start.pose.pose.position.y = 3.0, 2.0
    start.pose.pose.orientation = Message(x=0.0, y=0.0, z=math.sin(math.pi / 4.0), w=math.cos(math.pi / 4.0))
    start.pose.covariance = np.diag((0.01, 0.01, 0.0, 0.0, 0.0, 0.01)).ravel()
    node.callbacks["initialpose"](start)
    for i, speed in enumerate((0.25, 0.25, math.nan, 0.25, 0.25)):
        message = Message()
        message.header.stamp.sec, message.header.stamp.nanosec = 1_700_000_000 + i // 2, 500_000_000 * (i % 2)
        message.twist.twist.linear.x, message.twist.twist.angular.z = speed, 0.0
        node.callbacks["odom"](message)
    reads = [{"antenna": node.antenna, "epc": node.tag, "rssi": -60.0}]
    content = {"t": 1.7e9 + 2.0, "antennas": [node.antenna], "reads": reads}
    node.callbacks["rfid/reads"](SimpleNamespace(data=json.dumps(content)))
    node.timer()


FILES = sorted((ROOT / "scripts/experiments").glob("*.toml"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_an_experiment_file_is_valid_down_to_its_settings(file):
    experiment = read_experiment(file)
    assert experiment.name == file.stem
    for point in experiment.sweep.points():
        for entry in experiment.estimators:
            settings = deepcopy(dict(entry.settings))
            for key, value in point.items():
                first, _, rest = key.partition(".")
                if first == entry.shown:
                    set_key(settings, rest, value, file)
            settings_of(entry.name, settings)
        for log in experiment.logs:
            if log.log is not None:
                assert any(Path(name).match(Path(log.log).name) for name in (*manifests(), *CONVERTED)), log.log
                continue
            settings = deepcopy(dict(log.settings))
            for key, value in point.items():
                first, _, rest = key.partition(".")
                if first == SIMULATION:
                    set_key(settings, rest, value, file)
            preset(log.simulate, settings)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_an_experiment_file_is_in_the_documentation(file):
    assert f"scripts/experiments/{file.name}" in (ROOT / "docs/scripting.md").read_text()


@pytest.mark.usefixtures("runs_here")
def test_the_example_runs(tmp_path, monkeypatch, capsys):
    """The example, of fewer and shorter drives."""
    text = (ROOT / "scripts/example_experiment").read_text()
    shorter = text.replace('seeds = "0:6"', 'seeds = "0:2"').replace("duration = 30.0", "duration = 5.0")
    assert shorter.count("0:2") == shorter.count("duration = 5.0") == 1
    script = tmp_path / "example.py"
    script.write_text(shorter)
    monkeypatch.chdir(tmp_path)
    assert run_script(script) == 0
    told = capsys.readouterr().out
    assert re.search(r"plaza2, ekf: causal position RMSE 0\.\d\d m", told)
    assert "8 runs, 0 of them failed" in told
    assert (tmp_path / "out/example-experiment/errors.png").is_file()
    assert (tmp_path / "out/example-experiment/report.html").is_file()
    assert len(pl.read_parquet(tmp_path / "out/example-experiment/results.parquet")) == 8

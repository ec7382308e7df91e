"""The verbs as functions: they give what the commands print."""

import json
import tomllib

import numpy as np
import pytest
from in_short import blank_pictures, in_short, runs_here  # noqa: F401 - fixtures
from scripts_here import run_script

import factorgraph_loc as fgloc

SHORT = {"drive": {"duration": 20.0}, "world": {"tags": 12, "landmarks": 6}}


@pytest.fixture(scope="module")
def office():
    """A short drive through an office with tags and landmarks."""
    return fgloc.simulate("office", 3, changes=SHORT)


def test_a_run_has_the_scores_of_its_files(office, tmp_path):
    kept = fgloc.run(office, "ekf", sensors=["odometry", "bearing_range"], seed=2, out=tmp_path / "run")
    assert json.loads((tmp_path / "run/metrics.json").read_text())["final.position_rmse"] == pytest.approx(
        kept.scores["final.position_rmse"]
    )
    assert list((tmp_path / "run/plots").glob("*.png"))
    alone = fgloc.run(office, "ekf", sensors=["odometry", "bearing_range"], seed=2)
    assert f"| {office.name} | ekf " in repr(alone)
    assert f"{alone.scores['causal.position_rmse']:.3f}" in repr(alone)
    assert repr(alone.result).startswith(f"RunResult(log='{office.name}', estimator='ekf', ")
    assert f"bearing_range {len(office.streams['bearing_range'].t)} rows" in repr(office)
    assert len(repr(alone)) + len(repr(alone.result)) + len(repr(office)) < 1000
    assert alone.result.final.poses == pytest.approx(kept.result.final.poses, abs=0.0)
    with pytest.raises(fgloc.InputError, match="holds results already"):
        fgloc.run(office, "ekf", out=tmp_path / "run")


def test_compare_takes_names_and_settings_by_estimator(office, tmp_path):
    fgloc.convert(office, tmp_path / "log", format="parquet")
    found = fgloc.compare(
        tmp_path / "log", ["ekf"], tmp_path / "out", settings={"ekf": {"iterations": 2}}, seeds=range(2), jobs=1
    )
    assert [(row["log"], row["status"], row["seed"]) for row in found.rows] == [
        (office.name, "ok", 0)
    ]  # needs no seeds
    key = found.rows[0]["key"]
    config = tomllib.loads((tmp_path / "out/store" / key[:2] / key / "config.toml").read_text())
    assert config["settings"]["iterations"] == 2
    assert not found.failures
    assert repr(found).startswith("| log ")
    assert (tmp_path / "out/results.parquet").is_file()
    with pytest.raises(fgloc.InputError, match="settings are given for smoother"):
        fgloc.compare(office, ["ekf"], tmp_path / "other", settings={"smoother": {}})


def test_simulated_logs_are_those_of_the_same_seed(office, tmp_path):
    fgloc.simulate("office", 3, changes=SHORT, out=tmp_path / "log")
    (read,) = fgloc.load(str(tmp_path / "log"))
    assert np.array_equal(read.streams["odometry"].dx, office.streams["odometry"].dx)
    with pytest.raises(fgloc.InputError, match="images is true, but out is missing"):
        fgloc.simulate("office", images=True)


def test_an_experiment_gives_its_table(tmp_path):
    (tmp_path / "drives.toml").write_text(
        'name = "drives"\nlogs = [{simulate = "office", seeds = "0:2", settings = {drive = {duration = 5.0}}}]\n'
        'estimators = ["dead_reckoning"]\nsensors = ["odometry"]\n'
    )
    told = []
    done = fgloc.experiment(
        tmp_path / "drives.toml",
        changes={"simulation.drive.duration": 6.0},
        out=tmp_path / "out",
        jobs=1,
        progress=lambda *numbers: told.append(numbers),
    )
    assert not done.failures
    table = fgloc.load_results(tmp_path / "out")
    assert table["duration"].to_list() == [6.0, 6.0]
    assert table.equals(done.table)
    assert told == [(0, 2, 0), (1, 2, 0), (2, 2, 0)]
    with pytest.raises(fgloc.InputError, match="--jobs applies to this machine, but --scheduler names a cluster"):
        fgloc.experiment(tmp_path / "drives.toml", out=tmp_path / "out", jobs=1, scheduler="127.0.0.1:1")
    found = fgloc.status(tmp_path / "drives.toml", changes={"simulation.drive.duration": 6.0}, out=tmp_path / "out")
    assert found.labels == {"dead_reckoning": {"ok": 2, "failed": 0, "missing": 0, "damaged": 0}}
    changed = {"simulation.drive.duration": 6.0}
    page = fgloc.report(tmp_path / "drives.toml", changes=changed, out=tmp_path / "out")
    assert "dead_reckoning" in page.page.read_text()


def test_another_rig_and_map_are_values_or_files(office, tmp_path):
    blind = office.rig.model_copy(update={"sensors": ("odometry",)})
    fgloc.write_rig(blind, tmp_path / "blind.rig.toml")
    moved = {
        name: mark.model_copy(update={"x": mark.x + 1.0}) for name, mark in office.world.of(fgloc.Landmark).items()
    }
    world = office.world.model_copy(update={"landmarks": moved})
    fgloc.write_world(world, tmp_path / "moved.world.toml")
    fgloc.convert(office, tmp_path / "log")
    straight = fgloc.run(office, "ekf", sensors=["odometry"]).result.final.poses
    used = {"sensors": ["odometry", "bearing_range"]}
    shifted = fgloc.run(office, "ekf", world=world, **used).scores["final.position_rmse"]
    assert shifted > 2.0 * fgloc.run(office, "ekf", **used).scores["final.position_rmse"]
    for log in (office, tmp_path / "log"):
        for rig in (blind, tmp_path / "blind.rig.toml"):
            assert fgloc.run(log, "ekf", rig=rig).result.final.poses == pytest.approx(straight, abs=1e-6)
        for map_ in (world, str(tmp_path / "moved.world.toml")):
            found = fgloc.run(log, "ekf", world=map_, **used).scores["final.position_rmse"]
            assert found == pytest.approx(shifted, abs=1e-6)
    assert fgloc.load(tmp_path / "log", rig=blind, world=world)[0].rig == blind


def test_stored_results_are_written_for_other_programs(office, tmp_path):
    run = fgloc.run(office, "ekf", sensors=["odometry", "bearing_range"], out=tmp_path / "ekf")
    files = fgloc.export([tmp_path / "ekf", office], tmp_path / "ekf.kitti")
    assert files == [tmp_path / "ekf.kitti", tmp_path / "ekf.times.txt"]
    assert all(file.is_file() for file in files)
    assert fgloc.export([tmp_path / "ekf", office], tmp_path / "ekf.tum") == [tmp_path / "ekf.tum"]
    read = fgloc.Trajectory.of(fgloc.read_trajectory(tmp_path / "ekf.tum"), office.t0_ns)
    assert read.poses == pytest.approx(run.result.final.poses, abs=1e-8)
    with pytest.raises(fgloc.InputError, match=r"has the suffix '.csv', expected one of .mcap"):
        fgloc.export(office, tmp_path / "ekf.csv")
    with pytest.raises(fgloc.InputError, match="there are no results, expected folders of runs, or a log"):
        fgloc.export([], tmp_path / "other.tum")
    pytest.importorskip("rerun", reason="needs the extra viewer")
    fgloc.view([tmp_path / "ekf", office], rrd=tmp_path / "ekf.rrd")
    assert (tmp_path / "ekf.rrd").stat().st_size > 10_000


def test_a_bag_gets_a_manifest(tmp_path):
    pytest.importorskip("rosbags", reason="needs the extra ros")
    run_script("example_bag", tmp_path / "drive.bag", "--seconds", 5)
    found = fgloc.manifest(tmp_path / "drive.bag")
    assert found.folder == tmp_path
    (tmp_path / "drive.toml").write_text(found.text)
    assert {topic.use for topic in found.topics} >= {"odometry", "rfid", "reference"}
    assert tomllib.loads(found.text) == found.content
    assert fgloc.read_log(tmp_path / "drive.toml").rig == fgloc.read_rig(tmp_path / "drive.rig.toml")


def test_a_robot_seeks_its_place(tmp_path):
    told = []
    found = fgloc.active(
        "symmetric",
        tmp_path / "out",
        policies=["random"],
        changes={"max_metres": 1.0},
        jobs=1,
        progress=lambda *numbers: told.append(numbers),
    )
    assert [(row["policy"], row["status"]) for row in found.rows] == [("random", "ok")]
    assert told == [(0, 1), (1, 1)]
    with pytest.raises(fgloc.InputError, match="unknown key max_meters: did you mean max_metres"):
        fgloc.active("symmetric", tmp_path / "other", changes={"max_meters": 1.0})

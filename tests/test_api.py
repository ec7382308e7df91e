"""The verbs as functions: they give what the commands print, and importing the package costs nothing."""

import json
import subprocess
import sys
import tomllib
from dataclasses import replace

import numpy as np
import pytest

import factorgraph_loc as fgloc

SHORT = {"drive": {"duration": 20.0}, "world": {"tags": 12, "landmarks": 6}}


@pytest.fixture(scope="module")
def office():
    """A short drive through an office with tags and landmarks."""
    return fgloc.simulate("office", 3, changes=SHORT)


def test_the_package_is_light_and_knows_its_verbs():
    code = (
        "import sys, factorgraph_loc as fgloc\n"
        "assert {'numpy', 'gtsam', 'pydantic'}.isdisjoint(sys.modules)\n"
        "assert set(fgloc.__all__) <= set(dir(fgloc))\n"
        "print(all(getattr(fgloc, name) is not None for name in fgloc.__all__), 'numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "True True\n"


def test_what_is_no_verb_is_no_attribute():
    with pytest.raises(AttributeError, match="no attribute 'runn'"):
        fgloc.runn  # noqa: B018


def test_datasets_and_info(office):
    assert "plaza2" in {dataset.name for dataset in fgloc.datasets()}
    assert {"odometry", "rfid"} <= set(fgloc.info(office).streams)


def test_a_run_has_the_scores_of_its_files(office, tmp_path):
    kept = fgloc.run(office, "ekf", sensors=["odometry", "bearing_range"], seed=2, out=tmp_path / "run")
    assert json.loads((tmp_path / "run/metrics.json").read_text())["final.position_rmse"] == pytest.approx(
        kept.scores["final.position_rmse"]
    )
    assert list((tmp_path / "run/plots").glob("*.png"))
    alone = fgloc.run(office, "ekf", sensors=["odometry", "bearing_range"], seed=2)
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
    config = tomllib.loads((tmp_path / "out/runs/office-3/ekf/seed0/config.toml").read_text())
    assert config["settings"]["iterations"] == 2
    assert not found.failures
    assert (tmp_path / "out/results.parquet").is_file()
    with pytest.raises(fgloc.InputError, match="settings are given for smoother"):
        fgloc.compare(office, ["ekf"], tmp_path / "other", settings={"smoother": {}})


def test_simulated_logs_are_those_of_the_same_seed(office, tmp_path):
    fgloc.simulate("office", 3, changes=SHORT, out=tmp_path / "log")
    (read,) = fgloc.load(str(tmp_path / "log"))
    assert np.array_equal(read.streams["odometry"].dx, office.streams["odometry"].dx)
    with pytest.raises(fgloc.InputError, match="images need out"):
        fgloc.simulate("office", images=True)
    changes = {"drive": {"duration": 2.0}, "images": {"rate": 2.0}}
    seen = fgloc.simulate("office", changes=changes, images=True, out=tmp_path / "seen")
    assert all(path.is_file() for path in seen.streams["camera"].file)


def test_calibrate_writes_a_rig(tmp_path):
    changes = {"drive": {"duration": 60.0}, "world": {"tags": 0, "landmarks": 20}}
    log = fgloc.simulate("office", 1, changes=changes)
    streams = {name: log.streams[name] for name in ("odometry", "bearing_range")}
    log = replace(log, streams=streams, rig=log.rig.model_copy(update={"sensors": tuple(streams)}))
    made = fgloc.calibrate(log, tmp_path / "cart.rig.toml")
    assert fgloc.read_rig(tmp_path / "cart.rig.toml").odometry == made.rig.odometry
    assert (tmp_path / "cart.report.html").is_file()
    with pytest.raises(fgloc.InputError, match="exists already"):
        fgloc.calibrate(log, tmp_path / "cart.rig.toml")


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
    assert table.equals(done.rows)
    assert told == [(0, 2, 0), (1, 2, 0), (2, 2, 0)]
    page = fgloc.report(
        tmp_path / "drives.toml",
        changes={"simulation.drive.duration": 6.0},
        out=tmp_path / "out",
        page=tmp_path / "p.html",
    )
    assert "dead_reckoning" in page.read_text()


def test_map_writes_a_world(office, tmp_path):
    made = fgloc.map(office, tmp_path / "seen.world.toml", of="landmarks", estimator="ekf")
    assert set(fgloc.read_world(tmp_path / "seen.world.toml").landmarks) == set(made.world.landmarks) != set()
    assert (tmp_path / "seen.map.png").is_file()
    assert "the robot starts at" in made.frame  # few landmarks in common with the given map
    with pytest.raises(fgloc.InputError, match="exists already"):
        fgloc.map(office, tmp_path / "seen.world.toml", of="landmarks", estimator="ekf")


def test_a_misspelt_name_of_a_log_is_told():
    with pytest.raises(
        fgloc.InputError, match="neither a file, nor a folder, nor a known data set: did you mean plaza2"
    ):
        fgloc.info("plazza2")

"""Files as version 0.1.0 wrote them are read, with the values that are in them. The files are never written again."""

import json
import tomllib
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import factorgraph_loc as fgloc
from factorgraph_loc.experiments.experiment_file import read_experiment
from factorgraph_loc.experiments.store import Store
from factorgraph_loc.exports.runs import find_runs, read_runs

FILES = Path(__file__).parent / "files-0.1"


def contains(model, content):
    """Whether a model has each value of a table that it was read from."""
    if isinstance(content, dict):
        part = model.get if isinstance(model, dict) else lambda key: getattr(model, key)
        return all(contains(part(key), value) for key, value in content.items())
    return list(model) == list(content) if isinstance(content, list) else model == content


@pytest.mark.parametrize("name", ["office-csv", "office-parquet"])
def test_a_run_folder(name):
    log = fgloc.read_log(FILES / name)
    assert (log.name, log.t0_ns, log.warnings, log.metadata["seed"]) == ("office-7", 0, (), "7")
    odometry, rfid, seen, pixels = (log.streams[s] for s in ("odometry", "rfid", "bearing_range", "sightings"))
    assert isinstance(odometry, fgloc.IncrementStream)
    assert (len(odometry.t), odometry.t[-1]) == (81, 8.0)
    assert (odometry.dx.sum(), odometry.dtheta.sum()) == pytest.approx((3.465306177996274, -1.5377549812760152))
    assert (len(rfid.t), rfid.epc[:3]) == (73, ["", "T003", ""])
    assert (np.nanmean(rfid.rssi), np.nanmean(rfid.phase)) == pytest.approx((-59.40444781431685, 3.597810788452188))
    assert (len(seen.t), seen.landmark[:3]) == (40, ["L000", "L001", "L002"])
    assert seen.range[:3] == pytest.approx([8.26188683, 3.42248278, 6.6066426])
    assert (len(pixels.t), pixels.point[:2]) == (48, ["P0003", "P0013"])
    assert pixels.u[:2] == pytest.approx([381.40165856, 108.67301083])
    assert log.start.pose == pytest.approx([6.77293151, 0.43355239, -2.76180145])
    assert (len(log.reference), log.reference.has_heading) == (81, True)
    assert log.reference.poses[-1] == pytest.approx([5.20789244, 3.43342652, 2.0152161])
    assert (len(log.world.tags), len(log.world.landmarks), len(log.world.points), len(log.world.walls)) == (8, 5, 40, 4)
    assert log.rig.sensors == ("odometry", "rfid", "bearing_range", "sightings")
    assert contains(log.rig, tomllib.loads((FILES / name / "office-7.rig.toml").read_text()))


def test_a_run_folder_with_velocities_a_gyro_and_images():
    log = fgloc.read_log(FILES / "by-hand")
    assert (log.name, log.t0_ns) == ("by hand", 1_700_000_000_123_456_789)
    assert log.metadata == {"licence": "MIT", "origin": "made by hand"}
    assert isinstance(log.streams["odometry"], fgloc.VelocityStream)
    assert log.streams["odometry"].v.tolist() == [0.25] * 30
    assert (log.streams["imu"].t[0], log.streams["imu"].w[-1]) == (0.003, 0.033925)
    assert [file.name for file in log.streams["camera"].file] == ["000000.png", "000001.png", "000002.png"]
    assert log.start.t == pytest.approx(0.5)
    assert (log.start.pose.tolist(), log.start.sigmas.tolist()) == ([1.0, 2.0, 0.25], [0.2, 0.2, 0.05])
    assert (len(log.reference), log.reference.has_heading, log.rig.imu.bias) == (30, False, 0.01)


def test_a_run_file_with_rig_and_map_in_it():
    log = fgloc.read_log(FILES / "inline")
    assert (log.name, log.rig.bearing_range.range_sigma, log.rig.bearing_range.robust) == ("inline", 0.25, 5.0)
    assert log.world.landmarks == {"A": fgloc.Landmark(x=3.0, y=1.0)}
    assert log.streams["odometry"].w.tolist() == [0.0, 0.1, 0.1]
    assert log.streams["bearing_range"].bearing == pytest.approx([0.3, np.nan], nan_ok=True)
    rounds = [scan.tags for scan in log.streams["rfid"].measurements(0.0)]
    assert rounds == [("E1", "E2"), ("E1",)]
    assert log.start.sigmas.tolist() == [0.2, 0.2, 0.1]


def test_a_rig_with_every_sensor():
    rig = fgloc.read_rig(FILES / "rig/cart.rig.toml")
    content = tomllib.loads((FILES / "rig/cart.rig.toml").read_text())
    assert {"odometry", "imu", "bearing_range", "rfid", "twist", "camera", "camera_right", "survey"} < set(content)
    assert contains(rig, content)
    assert rig.rfid.models["grid"].model().logits[0, 1, 2, 3] == -1.219
    assert rig.rfid.model().tempering == 0.5
    assert list(fgloc.read_rig(FILES / "rig/preset.rig.toml").rfid.all_antennas()) == list("12345678")


def test_a_grid():
    grid = fgloc.read_grid(FILES / "rig/antenna.npz")
    assert (grid.logits.shape, grid.x0, grid.y0, grid.cell) == ((1, 4, 6, 5), -0.5, -1.0, 0.5)
    assert (grid.logits[0, 1, 2, 3], grid.heights.tolist()) == (-1.219, [1.2])


def test_a_world_with_tags_landmarks_points_and_walls():
    world = fgloc.read_world(FILES / "world/hall.world.toml")
    assert world.landmarks["door"] == fgloc.Landmark(x=1.0, y=2.0, sigma=0.05)
    assert world.landmarks["7"].covariance == (0.02, 0.005, 0.03)
    assert world.tags == {
        "E280-1": fgloc.Tag(x=1.0, y=0.5, z=1.2, facing=1.57, sigma=0.1),
        "E280-2": fgloc.Tag(x=2.0, y=0.5),
    }
    assert world.walls == ((0.0, 0.0, 5.0, 0.0), (5.0, 0.0, 5.0, 4.0))
    points = world.points
    assert (points.names, points.feature, points.owners.tolist()) == (("p1", "p2", "p3"), "orb", [0, 0, 1, 2])
    assert points.positions[1].tolist() == [-3.909, 2.716, 1.339]
    assert points.descriptors[1][:4].tolist() == [10, 213, 226, 115]
    assert points.covariances[2] == pytest.approx(0.01 * np.eye(3))
    assert points.sizes.tolist() == pytest.approx([31.0, 37.2, 31.0, 44.6])


def test_a_world_with_covariances_of_tags_and_one_with_markers():
    made = fgloc.read_world(FILES / "world/made.world.toml")
    assert made.tags["A"] == fgloc.Tag(x=1.0, y=2.0, z=1.0, facing=0.5, covariance=(0.01, 0.002, 0.02))
    assert made.tags["B"].sigma == 0.2
    points = fgloc.read_world(FILES / "world/markers.world.toml").points
    assert points.names == ("7/0", "7/1", "7/2", "7/3")
    assert points.positions[0] == pytest.approx([3.99219936, 1.11787361, 1.57774935])


def test_a_manifest_of_other_programs_tables():
    log = fgloc.read_log(FILES / "mapped/monday.toml")
    assert (log.name, log.t0_ns, log.metadata["title"]) == ("monday", 1_700_000_000 * 10**9, "Monday in the hall")
    assert log.streams["odometry"].dx.sum() == pytest.approx(1.7548935814401039)
    assert (len(log.streams["rfid"].t), set(log.streams["rfid"].antenna)) == (153, set("12345678"))
    assert (len(log.reference), log.start.pose.tolist()) == (51, [1.0, 2.0, 0.5])
    assert (len(log.world.walls), len(log.world.tags)) == (200, 40)
    tag = log.world.tags["T000"]
    assert (tag.x, tag.y, tag.z, tag.facing) == pytest.approx((6.155, 6.98, 1.2, -np.pi / 2))


def test_a_manifest_of_a_bag():
    pytest.importorskip("rosbags")
    log = fgloc.read_log(FILES / "bag/run.toml")
    assert (log.name, log.t0_ns, log.rig.name) == ("drive", 1_700_000_000 * 10**9, "cart")
    assert log.streams["odometry"].dx.sum() == pytest.approx(0.3365802233087322)
    assert (len(log.streams["rfid"].t), log.streams["rfid"].epc[:3]) == (61, ["T001", "T025", "T025"])
    assert (len(log.reference), len(log.world.tags)) == (21, 40)


def test_a_result_folder_and_what_was_learnt():
    log = fgloc.read_log(FILES / "office-csv")
    (run,) = read_runs(find_runs(FILES / "run"), log)
    assert (run.name, len(run.final), run.events) == ("smoother", 81, ())
    assert run.final.poses[-1] == pytest.approx([5.36353571, 3.59834467, 1.99575249])
    assert run.causal.poses[-1] == pytest.approx([5.36834115, 3.60109606, 1.99531837])
    assert run.played().covariances[-1, 0] == pytest.approx([0.04102129, 0.01154096, -0.00946011], rel=1e-5)
    assert run.series["nees"][1][-1] == pytest.approx(2.844237394457969)
    assert run.landmarks["L003"].position == pytest.approx([4.59842676, 0.2090107])
    assert run.landmarks["L003"].covariance[0] == pytest.approx([0.01082084, -0.00144921], rel=1e-5)
    constants = json.loads((FILES / "run/learnt.json").read_text())["constants"]
    assert constants["scale_distance"]["value"] == 0.014265578937229673
    assert run.folder.config.settings["landmarks"] == "unknown"


def test_a_comparison():
    folders = find_runs(FILES / "comparison")
    assert [(folder.log, folder.estimator) for folder in folders] == [
        ("office-7", "dead_reckoning"),
        ("office-7", "ekf"),
    ]
    runs = read_runs(folders, fgloc.read_log(FILES / "office-csv"))
    assert [len(run.final) for run in runs] == [81, 81]
    rows = pl.read_parquet(FILES / "comparison/results.parquet")
    assert rows["status"].to_list() == ["ok", "ok"]
    assert rows["causal.position_rmse"].is_not_null().all()


def test_an_experiment_with_results():
    experiment = read_experiment(FILES / "experiment/short.toml")
    assert [entry.shown for entry in experiment.estimators] == ["dead_reckoning", "loose"]
    assert experiment.report.baseline == "dead_reckoning"
    rows = fgloc.load_results(FILES / "experiment/results")
    assert rows.select("label", "sweep.simulation.world.tags", "status", "causal.position_rmse").rows() == [
        ("dead_reckoning", 4, "ok", 0.05030655938731354),
        ("loose", 4, "ok", 0.04195374916463472),
        ("dead_reckoning", 8, "ok", 0.05030655938731354),
        ("loose", 8, "ok", 0.04725909998715529),
    ]
    store = Store(FILES / "experiment/results")
    for key, error in rows.select("key", "causal.position_rmse").iter_rows():
        assert store.state(key, thorough=True) == "ok"
        assert store.row(key)["causal.position_rmse"] == error
    assert store.track(rows["key"][1]).final.poses[-1] == pytest.approx([17.14872246, 4.54544439, 2.48903706])


def test_the_settings_of_a_simulation():
    log = fgloc.simulate(FILES / "simulation.toml", 0)
    assert (log.span()[1], len(log.world.tags)) == (4.0, 6)

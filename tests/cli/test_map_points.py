"""`fgloc map` of points, from images to files and back to a run's map."""

import dataclasses
import json

import numpy as np
from PIL import Image

from factorgraph_loc.io.native.world_file import read_world

WALL = 3.0  # m, where the picture hangs


def test_points_lie_on_the_wall(fgloc, gallery_on_disk, tmp_path):
    out = tmp_path / "hall.world.toml"
    result = fgloc("map", gallery_on_disk(), "-o", out, "--json")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    world = read_world(out)
    assert report["points"] == len(world.points) > 60
    assert report["rms"] < 1.0
    assert world.points.feature == "sift"
    assert set(world.landmarks) == {"door"}
    assert world.walls == ((WALL, -2.0, WALL, 2.0),)
    off = world.points.positions[:, 0] - WALL
    assert np.median(np.abs(off)) < 0.05
    sigma = np.sqrt(world.points.covariances[:, 0, 0])
    assert np.mean(np.abs(off) < 3.0 * sigma) > 0.9
    with Image.open(tmp_path / "hall.map.png") as picture:
        assert picture.width == 1600
    assert report["frame"] == "that of the reference"


def test_a_map_is_thinned_extended_and_exported(fgloc, gallery_on_disk, tmp_path):
    log, few, both = gallery_on_disk(), tmp_path / "few.world.toml", tmp_path / "both.world.toml"
    assert fgloc("map", log, "-o", few, "--set", "points.most=40").exit_code == 0
    assert len(read_world(few).points) == 40
    result = fgloc("map", log, "--world", few, "--extend", "--of", "points", "-o", both, "--json")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["points"] == len(read_world(both).points) > 60
    assert 30 <= report["fused"] <= 40
    result = fgloc("export", log, "--world", both, "-o", tmp_path / "both.ply")
    assert result.exit_code == 0, result.output
    header, _, body = (tmp_path / "both.ply").read_text().partition("end_header\n")
    assert f"element vertex {report['points']}\n" in header
    rows = np.array([line.split() for line in body.splitlines()], dtype=float)
    np.testing.assert_allclose(rows[:, :3], read_world(both).points.positions, atol=1e-6)
    assert (rows[:, 4] >= 1).all()


UNKNOWN = ("-e", "smoother", "--set", "smoother.landmarks=unknown")


def test_a_run_without_a_map_writes_one(fgloc, gallery, gallery_on_disk, tmp_path):
    """Wheels that report a turn of 0.1 rad where there is none; images correct it, so that the points lie on the wall."""
    wheels = gallery.streams["odometry"]
    bent = dataclasses.replace(wheels, dtheta=wheels.dtheta + np.where(np.arange(len(wheels.t)) == 5, 0.1, 0.0))
    log = gallery_on_disk(streams={**gallery.streams, "odometry": bent})
    out = tmp_path / "monday"
    result = fgloc("run", log, *UNKNOWN, "-o", out)
    assert result.exit_code == 0, result.output
    world = read_world(out / "map.world.toml")
    assert f"a map of the {len(world.points)} points that were found is in {out / 'map.world.toml'}" in result.stdout
    assert set(world.landmarks) == {"door"}
    off = world.points.positions[:, 0] - WALL
    assert np.median(np.abs(off)) < 0.05
    assert np.mean(np.abs(off) < 3.0 * np.sqrt(world.points.covariances[:, 0, 0])) > 0.9
    assert world.points.common.shape == (len(world.points.owners), 3, 3)
    result = fgloc(
        "run", gallery_on_disk(), "-e", "smoother", "--world", out / "map.world.toml", "-o", tmp_path / "tuesday"
    )
    assert result.exit_code == 0, result.output
    assert "the map was made without a reference: it may be wrong by 0.0" in result.stderr
    scores = json.loads((tmp_path / "tuesday" / "metrics.json").read_text())
    assert scores["final.anees"] < 9.0  # wheels without noise: the odds are far better than one in a hundred
    assert scores["final.position_rmse"] < 0.05
    assert not list((tmp_path / "tuesday").glob("map.*"))
    # a map is not left behind where a run without one is written over it
    assert fgloc("run", log, "-e", "ekf", "--sensors", "odometry", "-o", out, "--overwrite").exit_code == 0
    assert not list(out.glob("map.*"))

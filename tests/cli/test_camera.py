"""Logs with images through the command line: looked at, copied, run, and with images that are not as they should be."""

import json
import re

import cv2
import numpy as np
import pytest

RUN = """\
name = "hall"
[rig]
name = "cart"
sensors = ["odometry", "camera"]
camera = { width = 160, height = 120, fx = 150.0, fy = 150.0, cx = 79.5, cy = 59.5, frontend = { feature = "orb", count = 50 } }
[start]
x = 0.0
y = 0.0
heading = 0.0
sigma_position = 0.1
sigma_heading = 0.05
"""


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    monkeypatch.setenv("FGLOC_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def hall(tmp_path):
    """Two seconds along a picture, with ten images."""
    folder = tmp_path / "hall"
    (folder / "camera").mkdir(parents=True)
    (folder / "run.toml").write_text(RUN)
    picture = cv2.GaussianBlur(np.random.default_rng(2).integers(0, 256, (120, 240, 3), dtype=np.uint8), (0, 0), 1.5)
    for k in range(10):
        cv2.imwrite(str(folder / "camera" / f"{k}.png"), picture[:, 4 * k : 4 * k + 160])
    stamps = [10**9 + k * 200_000_000 for k in range(10)]
    (folder / "odometry.csv").write_text("t_ns,v,w\n" + "".join(f"{t},0.5,0.0\n" for t in stamps))
    (folder / "camera.csv").write_text("t_ns,file\n" + "".join(f"{t},{k}.png\n" for k, t in enumerate(stamps)))
    return folder


def test_info(fgloc, hall):
    result = fgloc("info", hall)
    assert result.exit_code == 0
    line = r"images: 10, of 160x120 px; 10 of the 10 examined can be read, with \d\d orb features \(median\)"
    assert re.search(line, result.stdout)
    assert json.loads(fgloc("info", hall, "--json").stdout)["images"]["sizes"] == {"160x120": 10}


def test_convert_and_run(fgloc, hall, tmp_path):
    assert fgloc("convert", hall, tmp_path / "copy", "--format", "parquet").exit_code == 0
    result = fgloc("run", tmp_path / "copy", "-e", "ekf", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "images: features of 10 in " in result.stdout
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["timing.images"] == 10


def test_bad_images_are_told_of_and_the_run_goes_on(fgloc, hall, tmp_path):
    camera = hall / "camera"
    (camera / "1.png").unlink()
    (camera / "2.png").write_bytes((camera / "2.png").read_bytes()[:500])
    cv2.imwrite(str(camera / "3.png"), np.zeros((60, 80), dtype=np.uint8))
    cv2.imwrite(str(camera / "4.png"), np.zeros((120, 160), dtype=np.uint8))
    result = fgloc("run", hall, "-e", "ekf", "-o", tmp_path / "out")
    assert result.exit_code == 0
    for text in (
        "camera.csv: 1 of 10 images are missing and skipped, the first is 1.png of row 3",
        "hall: 1 of 9 images cannot be read and are without features",
        "hall: 1 of 9 images have another size and are without features",
        "hall: 1 of 9 images show no features",
    ):
        assert text in result.stderr

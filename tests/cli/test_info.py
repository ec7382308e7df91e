"""`fgloc info`: what it says of a log, and its picture."""

import json
import shutil

import cv2


def test_info(fgloc, short_log):
    result = fgloc("info", short_log)
    assert result.exit_code == 0
    for word in ("odometry", "bearing_range", "reference", "landmarks"):
        assert word in result.stdout
    content = json.loads(fgloc("info", short_log, "--json").stdout)
    assert content["streams"]["odometry"]["rows"] > 100
    assert content["suspects"] == []


def test_info_names_landmarks_that_are_swapped(fgloc, data_root, tmp_path):
    root = tmp_path / "root"
    shutil.copytree(data_root / "mrclam6", root / "mrclam6")
    path = root / "mrclam6" / "Landmark_Groundtruth.dat"
    lines = path.read_text().splitlines()
    rows = {line.split()[0]: i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")}
    a, b = rows["6"], rows["15"]
    lines[a], lines[b] = (
        " ".join(["6", *lines[b].split()[1:]]),
        " ".join(["15", *lines[a].split()[1:]]),
    )
    path.write_text("\n".join(lines) + "\n")
    content = json.loads(
        fgloc("info", root / "mrclam6", "--reader", "mrclam", "--reader-option", "robot=3", "--json").stdout
    )
    assert {(s["landmark"], s["swapped_with"]) for s in content["suspects"]} == {("6", "15"), ("15", "6")}


def test_info_draws_a_log(fgloc, short_log, tmp_path):
    picture = tmp_path / "new" / "log.png"
    result = fgloc("info", short_log, "-o", picture)
    assert result.exit_code == 0
    assert result.stdout.endswith(f"wrote {picture}\n")
    assert cv2.imread(str(picture)).shape[1] == 1600
    refused = fgloc("info", short_log, "-o", tmp_path / "log.pdf")
    assert refused.exit_code == 2
    assert "log.pdf: expected a name that ends in .png" in refused.stderr

"""`fgloc info`: what it says of a log, and its picture."""

import json

import cv2


def test_info(fgloc, short_log):
    result = fgloc("info", short_log)
    assert result.exit_code == 0
    for word in ("odometry", "bearing_range", "reference", "landmarks"):
        assert word in result.stdout
    content = json.loads(fgloc("info", short_log, "--json").stdout)
    assert content["streams"]["odometry"]["rows"] > 100
    assert content["suspects"] == []


def test_info_draws_a_log(fgloc, refused, short_log, tmp_path):
    picture = tmp_path / "new" / "log.png"
    result = fgloc("info", short_log, "-o", picture)
    assert result.exit_code == 0
    assert result.stdout.endswith(f"wrote {picture}\n")
    assert cv2.imread(str(picture)).shape[1] == 1600
    assert "expected a name that ends in .png" in refused("info", short_log, "-o", tmp_path / "log.pdf")

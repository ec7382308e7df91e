"""The steps of docs/quickstart.md, from files of other programs to a comparison."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scripts_here import run_script

from factorgraph_loc.io.readers import load

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "quickstart.md").read_text()


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    """The files of three programs, with the manifest and the map that the page shows."""
    folder = tmp_path_factory.mktemp("example") / "hall"
    run_script("example_folder", folder)
    (folder / "hall.world.toml").write_text(re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)[0])
    return folder


def test_the_tutorial(hall, fgloc, monkeypatch):
    monkeypatch.chdir(hall)
    proposed = fgloc("manifest", "monday")
    assert proposed.exit_code == 0
    assert proposed.stdout == re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)[1]
    Path("monday.toml").write_text(proposed.stdout)
    info = fgloc("info", "monday.toml")
    assert info.exit_code == 0
    for line in re.search(r"```text\n(.*?)```", PAGE, re.DOTALL).group(1).splitlines():
        assert line in info.stdout
    assert "2105 reads of 39 tags of the map" in info.stdout
    compared = fgloc("compare", "monday.toml", "-e", "dead_reckoning,smoother", "-o", "out", "--json")
    assert compared.exit_code == 0
    error = {row["estimator"]: row["final.position_rmse"] for row in json.loads(compared.stdout)["runs"]}
    rows = {words[1]: words for line in PAGE.splitlines() if (words := line.split())[:1] == ["monday"]}
    for estimator, position in error.items():
        assert float(rows[estimator][5]) == pytest.approx(position, rel=0.05)
    assert fgloc("convert", "monday.toml", "copy").exit_code == 0
    (log,), (copy,) = load("monday.toml"), load("copy")
    assert copy.world == log.world
    assert len(log.world.walls) > 20
    for column in ("t", "age", "round"):
        np.testing.assert_allclose(
            getattr(copy.streams["rfid"], column), getattr(log.streams["rfid"], column), rtol=0, atol=2e-9
        )
    np.testing.assert_array_equal(copy.streams["odometry"].dx, log.streams["odometry"].dx)

"""The experiment files, and the example of how to script one."""

import re
from copy import deepcopy
from pathlib import Path

import polars as pl
import pytest
from in_short import runs_here  # noqa: F401 - a fixture
from recorded_logs import CONVERTED
from scripts_here import run_script

from factorgraph_loc.evaluation.warned import SIMULATION
from factorgraph_loc.experiments.experiment_file import read_experiment
from factorgraph_loc.files.models import set_key
from factorgraph_loc.files.shipped import manifests
from factorgraph_loc.fusion.registry import settings_of
from factorgraph_loc.simulation import preset

ROOT = Path(__file__).parents[2]
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
    assert re.search(r"plaza2, ekf: off by 0\.\d\d m", told)
    assert "8 runs, 0 of them failed" in told
    assert (tmp_path / "out/example-experiment/errors.png").is_file()
    assert (tmp_path / "out/example-experiment/report.html").is_file()
    assert len(pl.read_parquet(tmp_path / "out/example-experiment/results.parquet")) == 8

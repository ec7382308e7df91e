"""The page of an experiment, from its store."""

import os

import pytest
from computed_here import run_planned

from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.experiment import prepare
from factorgraph_loc.experiments.keys import code_version
from factorgraph_loc.experiments.reporting import report_experiment

TEXT = """
name = "tiny"
logs = [{simulate = "office", settings = {drive = {duration = 4}}}]
estimators = ["dead_reckoning", {name = "dead_reckoning", label = "again & again", settings = {max_delay = 0.4}}]
[report]
metrics = ["causal.position_rmse"]
baseline = "again & again"
"""


@pytest.fixture
def prepared(tmp_path):
    """``prepared(...)``: the experiment, with some of its runs made."""
    (tmp_path / "tiny.toml").write_text(TEXT)

    def prepare_it(made=2):
        _, found = prepare(tmp_path / "tiny.toml", out=tmp_path / "out")
        for run in found.runs[:made]:
            assert run_planned(run, tmp_path / "out") == "ok"
        return prepare(tmp_path / "tiny.toml", out=tmp_path / "out")

    return prepare_it


def test_page_of_what_is_stored(prepared):
    page = report_experiment(*prepared()).page.read_text(encoding="utf-8")
    assert "2 estimators on 1 log: 2 runs. All succeeded." in page
    assert "Differences from again &amp; again" in page
    assert code_version() in page
    assert "opencv-python-headless" in page
    assert "max_delay = 0.4" in page
    assert '"walls":[' in page


def damage(run, store):
    """Change a byte of the trajectories, and neither their size nor their time of change."""
    file = store.path(run.key) / "estimates.parquet"
    before = file.stat()
    file.write_bytes(file.read_bytes()[:-1] + b"?")
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.usefixtures("blank_pictures")
def test_a_damaged_result_is_named_and_left_out(prepared):
    experiment, some = prepared()
    damage(some.runs[0], some.store)
    written = report_experiment(experiment, some)
    assert written.damaged == ["office-0, dead_reckoning, seed 0"]
    page = written.page.read_text(encoding="utf-8")
    assert "1 estimator on 1 log: 1 run." in page
    assert f"1 run is damaged, and excluded: <strong>{written.damaged[0]}</strong>" in page
    damage(some.runs[1], some.store)
    with pytest.raises(InputError, match=r"no runs to report on \(2 are damaged\)"):
        report_experiment(experiment, some)


@pytest.mark.usefixtures("blank_pictures")
def test_what_is_kept_beside_the_results_is_made_again_where_it_is_damaged(prepared, tmp_path):
    first = report_experiment(*prepared()).page.read_bytes()
    (scene,) = (tmp_path / "out/store/scenes").iterdir()
    for content in (b"", b"[]", b"5", b'{"walls": 3}', b"[" * 5000, b'{"files": {"a": 5}, "logs": 1}'):
        for file in (scene, *(tmp_path / "out/store").glob("*.json")):
            file.write_bytes(content)
        assert report_experiment(*prepared(made=0)).page.read_bytes() == first, content

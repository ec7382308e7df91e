"""The page of an experiment, from its store."""

import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.experiments.execute import run_planned
from factorgraph_loc.experiments.experiment import prepare
from factorgraph_loc.experiments.keys import code_version
from factorgraph_loc.experiments.log_source import SimulatedSource
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
        found = prepare(tmp_path / "tiny.toml", out=tmp_path / "out")
        for run in found.runs[:made]:
            assert run_planned(run, tmp_path / "out").status == "ok"
        return prepare(tmp_path / "tiny.toml", out=tmp_path / "out")

    return prepare_it


def test_page_of_what_is_stored(prepared):
    page = report_experiment(prepared()).read_text(encoding="utf-8")
    assert "2 estimators on 1 log: 2 runs. All went well." in page
    assert "Differences from again &amp; again" in page
    assert code_version() in page
    assert "opencv-python-headless" in page
    assert "max_delay = 0.4" in page
    assert '"walls":[' in page


def test_part_of_it_is_a_page_too(prepared, tmp_path):
    page = report_experiment(prepared(made=1)).read_text(encoding="utf-8")
    assert "1 estimator on 1 log: 1 run." in page
    assert "Differences from" not in page
    with pytest.raises(InputError, match="no runs"):
        report_experiment(prepare(tmp_path / "tiny.toml", out=tmp_path / "other"))


def test_logs_are_read_once(prepared, monkeypatch):
    first = report_experiment(prepared())
    before = first.read_bytes()
    monkeypatch.setattr(SimulatedSource, "load", lambda _: pytest.fail("was read again"))
    assert report_experiment(prepared(made=0)).read_bytes() == before


def test_a_log_that_has_vanished_is_drawn_without_map(prepared, monkeypatch):
    def vanished(_):
        raise InputError("is not there")

    some = prepared()
    monkeypatch.setattr(SimulatedSource, "load", vanished)
    assert '"scene":null' in report_experiment(some).read_text(encoding="utf-8")


def test_a_damaged_result_is_told(prepared):
    some = prepared()
    file = some.store.path(some.runs[0].key) / "estimates.parquet"
    file.write_bytes(file.read_bytes()[:-1] + b"?")
    with pytest.raises(InputError, match="is damaged"):
        report_experiment(some)
    assert not (some.folder / "report.html").exists()


def test_a_page_that_cannot_be_written_is_told(prepared, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        report_experiment(prepared(), tmp_path / "file" / "report.html")

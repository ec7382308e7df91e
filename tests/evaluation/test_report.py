"""The page as text: what stands in it, that it is whole and safe, and what it says of runs that fail or cannot be compared."""

import base64
import hashlib
import html
import io
import json
import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import polars as pl
import pytest
from in_short import blank_pictures  # noqa: F401 - a fixture

from factorgraph_loc.errors import InputError
from factorgraph_loc.evaluation.report import plots, tracks, write_report
from factorgraph_loc.evaluation.report.results import Results
from factorgraph_loc.evaluation.scores import metric_of
from factorgraph_loc.io.results import ResultFiles
from factorgraph_loc.text import significant

BAD = "<script>window.hacked = 1</script>\"'&</script><img src=x onerror=alert(1)> ../../etc"
LOGS = [f"log{i}" for i in range(8)]


def page_of(made, tmp_path, **more):
    write_report(made.rows, made.runs, tmp_path / "report.html", **more)
    return (tmp_path / "report.html").read_text(encoding="utf-8")


def words_of(page):
    """The text that people read."""
    body = re.sub(r"<(script|style)[^>]*>.*?</\1>", "", page, flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", body)).split())


def data_of(page):
    return json.loads(re.search(r'id="viewer">(.*?)</script>', page, flags=re.DOTALL)[1])


class Elements(HTMLParser):
    """Checks that elements are closed in order, and collects them. ``tables``: numbers of cells of the rows of each table."""

    def __init__(self, page):
        super().__init__()
        self.found, self.tables, self._open = [], [], []
        self.feed(page)
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append(0)
        elif tag in ("th", "td"):
            assert self._open[-1] == "tr"
            self.tables[-1][-1] += 1
        if tag not in ("meta", "link", "img"):
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag


def pictures_of(page):
    """The roots of the SVG pictures, which are all pictures of the page."""
    uris = [a["src"] for t, a in Elements(page).found if t == "img"]
    assert all(uri.startswith("data:image/svg+xml;base64,") for uri in uris)
    return [ElementTree.fromstring(base64.b64decode(uri.partition(",")[2])) for uri in uris]


def troubled(made):
    """Runs of which some failed and some have warnings."""
    some = made({"a": 0.1, "b": 0.2}, LOGS[:2], 2, count=40)
    failed = pl.col("key").is_in(["0002", "0006"])
    some.rows = some.rows.with_columns(
        status=pl.when(failed).then(pl.lit("failed")).otherwise("status"),
        kind=pl.when(failed).then(pl.lit("timeout")).otherwise(None),
        reason=pl.when(failed).then(pl.lit("took longer than 60 s")).otherwise(None),
        warnings=pl.when(pl.col("log") == "log1").then(pl.lit("the map is empty\nodometry stops")).otherwise(None),
        **{"causal.position_rmse": pl.when(failed).then(None).otherwise("causal.position_rmse")},
    )
    return some


@pytest.fixture(scope="module")
def eight(made):
    return made({"ekf": 0.1, "smoother": 0.1, "dead": 0.5}, LOGS, 2, count=200)


def test_is_whole_and_the_same_each_time(eight, tmp_path):
    page = page_of(eight, tmp_path)
    elements = Elements(page).found
    assert not [a for _, a in elements if {"onclick", "style"} & set(a)]
    assert len(pictures_of(page)) == 4
    assert [a["href"] for t, a in elements if t == "link"] == ["data:,"]
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", page)
    (policy,) = [a["content"] for t, a in elements if a.get("http-equiv") == "Content-Security-Policy"]
    for tag in ("style", "script"):
        content = re.search(rf"<{tag}>(.*?)</{tag}>", page, flags=re.DOTALL)[1]
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy
    assert page == page_of(eight, tmp_path)


def test_every_string_is_escaped(made, tmp_path):
    bad = made({BAD: 0.1, "ekf": 0.2}, [BAD, "good"], count=40)
    bad.rows = bad.rows.with_columns(
        status=pl.when(pl.col("key") == "0003").then(pl.lit("failed")).otherwise("status"),
        reason=pl.lit(BAD),
        kind=pl.lit(BAD),
        warnings=pl.lit(BAD),
    )
    bad.config = f"log = {json.dumps(BAD)}\n".encode()
    names = {"title": BAD, "experiment": {"name": BAD, BAD: [BAD, None]}, "versions": {BAD: BAD}}
    page = page_of(bad, tmp_path, baseline=BAD, **names)
    elements = Elements(page).found
    drawn = [one for picture in pictures_of(page) for one in picture.iter()]
    assert not [one for one in drawn if one.tag.rpartition("}")[2] in ("script", "img", "image", "foreignObject")]
    assert len([t for t, a in elements if t == "script" and "type" not in a]) == 1
    assert data_of(page)["logs"] == [BAD, "good"]
    assert BAD in words_of(page)


@pytest.mark.usefixtures("blank_pictures")
def test_failures_and_warnings_stand_with_their_runs(made, tmp_path):
    words = words_of(page_of(troubled(made), tmp_path))
    assert "2 warnings , in 4 of 8 runs. 2 estimators on 2 logs" in words
    assert "8 runs. 2 of them failed." in words
    assert "b 2 timeout took longer than 60 s log0, seed 0; log1, seed 0" in words
    assert "the map is empty 4 log1, a; log1, b" in words
    assert "2 of 4 [15, 85] %" in words


@pytest.mark.usefixtures("blank_pictures")
def test_rows_of_tables_have_a_cell_in_each_column(made, tmp_path):
    tables = Elements(page_of(troubled(made), tmp_path, versions={"gtsam": "4.3.0"})).tables
    assert len(tables) == 11  # results, differences, five metrics, times, warnings, failures, versions
    for widths in tables:
        assert len(widths) > 1
        assert len(set(widths)) == 1


@pytest.mark.usefixtures("blank_pictures")
def test_a_log_with_hardly_any_reference_is_not_scored(made, tmp_path):
    some = made({"a": 0.1, "b": 0.2}, LOGS[:2], count=40)
    poor = pl.col("log") == "log1"
    some.rows = some.rows.with_columns(
        **{f"{k}.scored": pl.when(poor).then(1).otherwise(40) for k in ("causal", "final")},
        **{"causal.position_rmse": pl.when(poor).then(0.0).otherwise("causal.position_rmse")},
    )
    words = words_of(page_of(some, tmp_path))
    assert "Fewer than 10 poses of log1 have a reference, so these logs have no scores." in words
    assert Results(some.rows).scores("causal.position_rmse", "a")["log1"] == {0: None}


@pytest.mark.usefixtures("blank_pictures")
def test_swept_settings_are_drawn_and_told_apart(made, tmp_path):
    swept = made({"ekf": 0.1}, LOGS[:2], count=40, sweep=("sweep.ekf.lag", [1.0, 2.0, 4.0]))
    page = page_of(swept, tmp_path)
    assert data_of(page)["variants"] == ["ekf (lag 1)", "ekf (lag 2)", "ekf (lag 4)"]
    lines = plots.sweep(Results(swept.rows), "sweep.ekf.lag", metric_of("causal.position_rmse"))
    lags, values, low, high = np.transpose(lines["ekf"])
    assert list(lines) == ["ekf"]
    assert lags.tolist() == [1.0, 2.0, 4.0]
    assert values.tolist() == sorted(values)
    assert np.all((low <= values) & (values <= high))


def test_a_swept_simulation_makes_other_logs(made):
    swept = made({"ekf": 0.1}, LOGS[:1], count=40, sweep=("sweep.simulation.tags", [10, 20]))
    results = Results(swept.rows)
    assert list(results.variants) == ["ekf"]
    assert results.logs == {"log0 (tags 10)": "log0", "log0 (tags 20)": "log0"}
    assert results.compare(metric_of("causal.position_rmse")).pooled["ekf"].logs == 1


def test_without_runs_there_is_no_page(made, tmp_path):
    some = made({"ekf": 0.1}, LOGS[:1], count=40)
    with pytest.raises(InputError, match="no runs"):
        write_report(some.rows[:0], some.runs, tmp_path / "none.html")
    assert not (tmp_path / "none.html").exists()


def _estimates(content):
    return ResultFiles(lambda _: content).estimates()


def test_thinned_errors_keep_their_extremes(made):
    some = made({"ekf": 0.1}, ["one"], count=5000)
    series = _estimates(some.tables["0000"])["causal"]
    thinned = tracks.thinned(series, 100)
    t, x, errors = (np.array(thinned[name]) for name in "txe")
    assert 50 <= len(errors) <= 102
    all_errors = series.errors["error_position"]
    assert errors.max() == pytest.approx(all_errors.max(), abs=1e-3)
    assert errors.min() == pytest.approx(all_errors.min(), abs=1e-3)
    assert (t[0], t[-1]) == pytest.approx((0.0, 499.9))
    rows = np.searchsorted(series.trajectory.t, t - 1e-6)
    assert x == pytest.approx(series.trajectory.poses[rows, 0], abs=1e-3)


def test_series_begin_with_the_first_localized_pose(made):
    some = made({"ekf": 0.1}, ["one"], count=30)
    table = pl.read_parquet(some.tables["0000"])
    early = (pl.col("t_ns") < 1_000_000_000) & (pl.col("kind") == "causal")
    changed = table.with_columns(status=pl.when(early).then(pl.lit("unlocalized")).otherwise("status"))
    series = _estimates(_bytes(changed))
    assert series["causal"].trajectory.t[0] == pytest.approx(1.0)
    assert series["final"].trajectory.t[0] == 0.0
    assert len(series["causal"].errors["error_position"]) == 20
    never = table.with_columns(status=pl.lit("unlocalized"), error_heading=pl.lit(None, dtype=pl.Float64))
    series = _estimates(_bytes(never))
    assert not len(series["causal"].trajectory)
    assert tracks.consistency(series["final"])[2] == 2


def test_consistent_runs_are_told_to_be_so(made):
    series = _estimates(made({"ekf": 0.1}, ["one"], count=20000).tables["0000"])["causal"]
    mean, independent, dof = tracks.consistency(series)
    assert dof == 3
    assert mean == pytest.approx(3.0, abs=0.45)  # sigma of the mean: sqrt(6 / independent), 0.1
    assert 200 < independent < 5000


NUMBERS = {
    0.29381: "0.294",
    31.49: "31.5",
    4321.0: "4\u202f321",
    1234567.0: "1\u202f234\u202f567",
    -9876543210.0: "\u22129\u202f876\u202f543\u202f210",
    -0.00012345: "\u22120.000123",
    0.0: "0",
}


@pytest.mark.parametrize(("value", "text"), NUMBERS.items())
def test_numbers_have_three_digits(value, text):
    assert significant(value) == text


def _bytes(table):
    buffer = io.BytesIO()
    table.write_parquet(buffer)
    return buffer.getvalue()

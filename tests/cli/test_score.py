"""``fgloc score``: tables, documents, files, and what is refused."""

import json

import polars as pl
import pytest
from pose_files import wander, write

from factorgraph_loc import score


@pytest.fixture
def pair(tmp_path):
    reference, estimate = wander(7)
    return write(tmp_path / "estimate.tum", estimate), write(tmp_path / "reference.tum", reference)


def test_the_errors_are_a_table(fgloc, pair):
    result = fgloc("score", *pair, "--align", "sim3")
    assert result.exit_code == 0, result.output
    figures = score(*pair, align="sim3").figures
    (row,) = (line for line in result.stdout.splitlines() if line.startswith("absolute position [m]"))
    expected = [figures[f"ape.position_{how}"] for how in ("rmse", "mean", "median", "p95", "max", "min", "std")]
    assert row.split()[3:] == [f"{value:.4f}" for value in expected]
    assert "pairs      100, nearest stamps, at most 0.01 s apart; 9." in result.stdout
    assert "alignment  sim3: translation (" in result.stdout


def test_the_document_holds_all_figures(fgloc, pair):
    document = json.loads(fgloc("score", *pair, "--associate", "interpolate", "--json").stdout)
    figures = score(*pair, associate="interpolate").figures
    assert {key: document[key] for key in figures} == pytest.approx(figures)
    assert (document["associate"], document["max_gap"], document["align"]) == ("interpolate", 0.5, "none")
    assert document["estimate"] == str(pair[0])


@pytest.mark.parametrize("suffix", [".tum", ".kitti"])
def test_the_folder_holds_a_report(fgloc, refused, tmp_path, suffix):
    reference, estimate = wander(7)
    pair = write(tmp_path / f"estimate{suffix}", estimate), write(tmp_path / f"reference{suffix}", reference)
    out = tmp_path / "out"
    result = fgloc("score", *pair, "-o", out)
    assert result.stdout.endswith(f"results are in {out}: report.html, score.json, errors.csv, plots/\n")
    figures = json.loads((out / "score.json").read_text())
    table = pl.read_csv(out / "errors.csv")
    assert table["error_position"].max() == pytest.approx(figures["ape.position_max"])
    assert len(table) == figures["pairs"] == 100
    report = (out / "report.html").read_text()
    assert report.count("data:image/png;base64,") == 2
    assert f"{figures['ape.position_rmse']:.4f}" in report
    assert f"{figures['rpe_per_m.position_max']:.4f}" in report
    assert sorted(path.name for path in (out / "plots").iterdir()) == ["errors.png", "trajectories.png"]
    assert "holds results already (errors.csv)" in refused("score", *pair, "-o", out)
    assert fgloc("score", *pair, "-o", out, "--overwrite").exit_code == 0

"""What `fgloc run` and `fgloc compare` say of the errors: how often they are scored, after an alignment, and in doubt."""

import json

import pytest


def test_relative_errors_and_an_alignment_are_shown_where_they_are_asked_for(fgloc, short_log, tmp_path):
    plain = fgloc("run", short_log, "-e", "ekf", "-o", tmp_path / "plain")
    assert "relative errors" not in plain.stdout
    assert "after alignment" not in plain.stdout
    result = fgloc("run", short_log, "-e", "ekf", "-o", tmp_path / "run", "--align", "sim3", "--rpe")
    assert result.exit_code == 0, result.output
    scored = fgloc("score", tmp_path / "run", short_log, "--associate", "interpolate", "--align", "sim3", "--json")
    scored = json.loads(scored.stdout)
    lines = result.stdout.splitlines()
    of_final = [line.split()[1:] for line in lines if line.startswith("final ")]
    aligned, relative = of_final[1:3]
    assert [float(cell) for cell in aligned] == pytest.approx(
        [scored["ape.position_rmse"], scored["ape.rotation_rmse"]], abs=6e-4
    )
    unaligned = json.loads(fgloc("score", tmp_path / "run", short_log, "--associate", "interpolate", "--json").stdout)
    keys = [f"rpe_per_{per}.{what}_rmse" for per in ("m", "s") for what in ("position", "rotation")]
    assert [float(cell) for cell in relative] == pytest.approx([unaligned[key] for key in keys], abs=6e-5)
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert metrics["scoring.align"] == "sim3"
    assert metrics["final.aligned_position_rmse"] == pytest.approx(scored["ape.position_rmse"], abs=1e-6)
    assert metrics["final.rpe_position_per_s"] == pytest.approx(unaligned["rpe_per_s.position_rmse"], abs=1e-6)

    both = fgloc("compare", short_log, "-e", "ekf", "-o", tmp_path / "out", "--align", "sim3", "--rpe")
    assert both.exit_code == 0, both.output
    for text in (both.stdout, (tmp_path / "out/table.md").read_text()):
        assert "errors after alignment by sim3" in text
        assert "relative errors over a metre of path, and over a second" in text
        assert f"{metrics['final.aligned_position_rmse']:.3f}" in text
        assert f"{metrics['final.rpe_position_per_s']:.4f}" in text
    page = (tmp_path / "out/report.html").read_text()
    assert "final aligned position RMSE" in page
    assert "m per s" in page

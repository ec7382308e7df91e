"""`fgloc compare`, from the arguments to the files."""

import shutil

import polars as pl


def test_compare_prints_one_table_with_seeds_pooled_and_the_best_in_words(fgloc, refused, short_log, tmp_path):
    out = tmp_path / "out"
    both = ("-e", "dead_reckoning,particle_filter", "--set", "particle_filter.particles=500")
    result = fgloc("compare", short_log, *both, "-o", out, "--seeds", "0:2", "--jobs", 2)
    assert result.exit_code == 0, result.output
    lines = [line.split() for line in result.stdout.splitlines()]
    assert [line[-1] for line in lines if line[:1] == ["short"]] == ["1/1", "2/2"]
    assert "least causal position error: particle_filter, " in result.stdout
    assert "(dead_reckoning: " in result.stdout
    for name in ("results.parquet", "results.csv", "table.md", "differences.csv", "plots", "store"):
        assert name in result.stdout
        assert (out / name).exists()
    assert list(out.rglob("*.png"))
    assert "--overwrite" in refused("compare", short_log, "-e", "ekf", "-o", out)


def test_compare_without_a_folder_makes_a_new_one(fgloc, short_log, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("compare", "compare-2"):
        assert f"results are in out/{name}: " in fgloc("compare", short_log, "-e", "dead_reckoning").stdout
        assert (tmp_path / "out" / name / "report.html").exists()


def test_compare_reports_a_failed_run_and_goes_on(fgloc, short_log, tmp_path):
    nowhere = tmp_path / "nowhere"
    shutil.copytree(short_log, nowhere)
    (nowhere / "reference.tum").unlink()
    run_file = nowhere / "run.toml"
    run_file.write_text(run_file.read_text().replace('name = "short"', 'name = "nowhere"'))
    result = fgloc("compare", short_log, nowhere, "-e", "dead_reckoning", "-o", tmp_path / "out")
    assert result.exit_code == 1
    assert "failed: nowhere, dead_reckoning, seed 0: dead_reckoning cannot start" in result.stderr
    assert "least final position error" not in result.stdout
    table = pl.read_csv(tmp_path / "out/results.csv")
    assert table["status"].to_list() == ["ok", "failed"]
    assert table["final.position_rmse"].null_count() == 1

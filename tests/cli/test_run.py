"""`fgloc run`, from the arguments to the files."""

import tomllib

import polars as pl
import pytest
from tum_files import read_tum


@pytest.mark.in_full
def test_run_writes_its_files_and_says_where(fgloc, short_log, tmp_path):
    out = tmp_path / "out"
    result = fgloc("run", short_log, "-e", "ekf", "-o", out, "--seed", 3)
    assert result.exit_code == 0, result.output
    plots = {f"short-{name}.png" for name in ("trajectories", "errors-ekf", "consistency-ekf")}
    assert {path.name for path in (out / "plots").iterdir()} == plots
    assert str(out) in result.stdout
    assert "causal" in result.stdout
    assert "final" in result.stdout
    assert tomllib.loads((out / "config.toml").read_text())["seed"] == 3
    assert len(read_tum(out / "final.tum")) > 500
    assert set(pl.read_parquet(out / "estimates.parquet")["kind"]) == {"causal", "final"}

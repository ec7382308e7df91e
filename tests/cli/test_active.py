"""``fgloc active``: a table, files, JSON, and errors of one line."""

import polars as pl

SMALL = ("--set", "world.width=8", "--set", "world.plan=hall", "--set", "world.depth=6", "--set", "world.tags=12")
FEW = ("--set", "particles=300", "--set", "policy.samples=16")


def test_policies_are_compared(fgloc, refused, tmp_path):
    out = tmp_path / "out"
    few = (*SMALL[:-1], "world.tags=4", "--set", "max_metres=3")
    done = fgloc("active", "office", "--policy", "information,random", "--seeds", "0:2", *few, *FEW, "-o", out)
    assert done.exit_code == 0, done.stderr
    for text in ("median [m]", "information / random", "p (McNemar)"):
        assert text in done.stdout
    rows = pl.read_parquet(out / "results.parquet")
    assert sorted(rows.select("policy", "seed").rows()) == [(p, s) for p in ("information", "random") for s in (0, 1)]
    assert (rows["metres"] <= 3.3).all()  # a step of a way more
    assert (out / "plots" / "comparison.png").exists()
    assert "holds results already" in refused("active", "office", "--seeds", "0:2", "-o", out)


def test_a_robot_that_finds_nothing_gives_up(fgloc, tmp_path):
    out = tmp_path / "out"
    bare = (*SMALL[:-1], "world.tags=0")
    done = fgloc("active", "office", *bare, *FEW, "--policy", "patrol", "--set", "max_metres=3", "-o", out)
    assert done.exit_code == 0, done.stderr  # that is a result
    (row,) = pl.read_parquet(out / "results.parquet").to_dicts()
    assert not row["localized"]
    assert 2.0 < row["metres"] <= 3.3  # a step of its way more
    assert "never" in done.stdout

"""The benchmarks are outside of the gate: only that they fit the package is tested, and that one measures."""

from importlib import import_module
from runpy import run_path

from scripts_here import SCRIPTS

BENCHMARKS = SCRIPTS / "benchmarks"


def test_the_benchmarks_fit_the_package(monkeypatch, tmp_path, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    for script in (SCRIPTS / "bench", BENCHMARKS / "smoother_or_filter", *BENCHMARKS.glob("bench_*")):
        sections = run_path(str(script)).get("SECTIONS", ())
        package = script.name.removeprefix("bench_") + "_benchmark"
        if (BENCHMARKS / package).is_dir():
            assert all(callable(import_module(f"{package}.{name}").section) for name in sections)
    quick = import_module("speed_benchmark.quick")
    log = quick.landmark_log(3.0)
    loop = quick.numpy_filters.ekf, quick.problem_of(log)
    pair = quick.Pair(quick._run(log, quick.CONFIGS["EKF"]), quick._loop(*loop), "numpy EKF")
    monkeypatch.setattr(quick, "workloads", lambda: {"EKF": pair})
    assert quick.quick(tmp_path / "quick.json", None) == 0
    assert "| EKF |" in capsys.readouterr().out
    assert quick.read_ratios(tmp_path / "quick.json")["EKF"] > 0.0

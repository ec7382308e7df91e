"""The benchmarks are outside of the gate: only that they fit the package is tested, and that one measures."""

from importlib import import_module

from scripts_here import SCRIPTS

BENCHMARKS = SCRIPTS / "benchmarks"


def test_the_benchmarks_fit_the_package(monkeypatch, tmp_path, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    for package in BENCHMARKS.glob("*_benchmark"):
        assert all(callable(section) for section in import_module(package.name).SECTIONS.values())
    quick, ours = (import_module(f"landmarks_benchmark.{name}") for name in ("quick", "ours"))
    log = quick.landmark_log(3.0)
    problem = quick.problem_of(log)
    pair = ours.timed_run(log, ours.CONFIGS["EKF"], problem), ours.timed_loop(quick.numpy_filters.ekf, problem)
    monkeypatch.setattr(quick, "workloads", lambda: ({"EKF": pair}, {"EKF": "numpy EKF"}))
    assert quick.quick(tmp_path / "quick.json", None) == 0
    assert "| EKF |" in capsys.readouterr().out
    assert quick.read_ratios(tmp_path / "quick.json")["EKF"] > 0.0
    found, reference = ours.least({"EKF": pair}, 1)["EKF"]
    assert abs(found.position - reference.position) < 0.05

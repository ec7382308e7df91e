"""Comparison of a smoother with filters: the sections of docs/smoother-or-filter.md, from scripts/experiments/smoothing."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from time import process_time

from benchmarking.report import Options, Report

from factorgraph_loc.evaluation.figures import write_picture
from factorgraph_loc.experiments.experiment import prepare, run_experiment
from factorgraph_loc.experiments.run import run
from smoothing_benchmark.cases import Case, cases_of
from smoothing_benchmark.picture import picture
from smoothing_benchmark.tables import accuracy, ratios, times

FILES = Path(__file__).parents[2] / "experiments/smoothing"
MINUTE = 60.0  # s
# for each section the files of its experiments, and for each file the title of each list of sensors
EXPERIMENTS = {
    "known-map": {
        "sensors": {
            "odometry,bearing_range": "landmarks",
            "odometry,rfid": "tags",
            "odometry,rfid,phase": "tags with phase",
            "odometry,sightings": "camera",
        }
    },
    "ranges": {"ranges": {"": "ranges"}},
    "wrong-models": {"wrong_models": {"": "tags, wrong models"}},
    "no-map": {
        "no_map": {"odometry,bearing_range": "landmarks, no map"},
        "no_map_camera": {"odometry,sightings": "camera, no map"},
    },
}


def tables(section: str, options: Options) -> Report:
    """Run the experiments of a section, and return their tables. Stored runs are not repeated."""
    report = Report(section, options)
    cases = cases_of_section(section, report)
    if section == "ranges":
        accuracy(report, [one for case in cases for one in case.of_logs()])  # too few logs for ratios with intervals
    else:
        accuracy(report, cases)
        ratios(report, cases)
    return report


def cases_of_section(section: str, report: Report) -> list[Case]:
    """Run the experiments of a section, and return their cases."""
    cases: list[Case] = []
    for name, names in EXPERIMENTS[section].items():
        _, prepared = prepare(FILES / f"{name}.toml", out=report.options.out / name)
        done = run_experiment(prepared, jobs=report.options.jobs)
        report.failed += done.failures
        cases += cases_of(done.rows, names)
    return cases


def processor_time(options: Options) -> Report:
    """Measure the processor time [s] per minute of drive on the first log of each experiment, and draw the picture of all
    experiments.

    Each run is repeated, and the second one is measured, because the first one compiles functions. The time includes causal
    estimates and final trajectory, but neither simulation nor scoring.
    """
    report, found = Report("processor-time", options), dict[tuple[str, str], float]()
    cases = [case for section in EXPERIMENTS for case in cases_of_section(section, report)]
    write_picture(picture(cases), options.out / "ratios.png")
    for experiments in EXPERIMENTS.values():
        for file, names in experiments.items():
            _, prepared = prepare(FILES / f"{file}.toml", out=options.out / file)
            first = prepared.runs[0]
            log = first.source.load()
            for planned in prepared.runs:
                name = names.get(",".join(planned.sensors or ()))
                if planned.log == first.log and name is not None:
                    run(log, planned)
                    started = process_time()
                    run(log, planned)
                    found[name, planned.label] = (process_time() - started) * MINUTE / planned.duration
    times(report, found)
    return report


SECTIONS = {section: partial(tables, section) for section in EXPERIMENTS} | {"processor-time": processor_time}

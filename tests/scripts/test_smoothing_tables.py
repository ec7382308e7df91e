"""The tables of docs/smoother-or-filter.md: what is pooled, what is paired, and that they are made from an experiment's runs."""

from pathlib import Path

import pytest
from benchmarking.command import with_tables
from smoothing_tables.cases import FILES, SECTIONS, Case, cases_of
from smoothing_tables.picture import picture
from smoothing_tables.processor_time import seconds_per_minute
from smoothing_tables.tables import accuracy, hindsight, ratios, times

from factorgraph_loc.experiments.experiment import prepare, run_experiment
from factorgraph_loc.experiments.experiment_file import read_experiment
from factorgraph_loc.simulation.settings import named_settings

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/smoother-or-filter.md"
NAMES = [name for experiments in SECTIONS.values() for name in experiments]
TINY = """
name = "tiny"
logs = [{ simulate = "room.toml", seeds = "0:2" }]
estimators = ["ekf", "smoother"]
sensors = [["odometry", "bearing_range"], ["odometry", "rfid"]]
"""
ROOM = """
preset = "office"
world = { plan = "hall", width = 6.0, depth = 4.0, tags = 8, landmarks = 4 }
drive = { duration = 6.0 }
"""


def row(label, log, causal, final, **others):
    scores = {"causal.position_rmse": causal, "causal.anees": 3.0, "final.position_rmse": final, "final.anees": 4.0}
    return {"label": label, "log": log, "sensors": "odometry,rfid", "status": "ok"} | scores | others


@pytest.fixture
def six():
    """A smoother with half of the EKF's causal error on each of six logs, and a third of its final one."""
    errors = [(f"office-{i}", 0.1 * (i + 1)) for i in range(6)]
    filters = [row("ekf", log, error, error) for log, error in errors]
    return [row("smoother", log, error / 2.0, error / 3.0) for log, error in errors] + filters


def cells(lines):
    """The cells of a table below its heads."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line]
    return rows[2:]


def test_errors_are_pooled_as_squares_and_anees_as_a_mean():
    rows = [row("ekf", "a", 0.3, 0.03), row("ekf", "b", 0.4, 0.04, **{"causal.anees": 5.0})]
    (found,) = cells(accuracy([Case("tags", rows)]))
    assert found == ["tags", "EKF", "0.354", "4.0", "0.035", "4.0"]


def test_the_smoother_comes_last_and_is_divided_by_each_filter(six):
    found = cells(ratios([Case("tags", six)]))
    assert [line[:2] for line in cells(accuracy([Case("tags", six)]))] == [["tags", "EKF"], ["tags", "smoother"]]
    assert found == [["tags", "smoother / EKF", "0.500 (0.500 to 0.500)", "0.333 (0.333 to 0.333)"]]
    assert cells(hindsight([Case("tags", six)]))[1][2] == "0.667 (0.667 to 0.667)"


def test_intervals_pair_the_logs_and_need_six(six):
    """Logs differ by a factor of six, but no ratio does, so the interval has no width; without pairing it would have one."""
    five = [one for one in six if one["log"] != "office-5"]
    assert cells(ratios([Case("tags", five)])) == [["tags", "smoother / EKF", "0.500", "0.333"]]
    worse = [one | {"causal.position_rmse": 1.0} if one["label"] == "smoother" else one for one in six]
    low, high = cells(ratios([Case("tags", worse)]))[0][2].split(" (")[1].strip(")").split(" to ")
    assert float(low) < 2.5 < float(high)


def test_a_log_without_one_of_the_two_is_left_out(six):
    alone = row("ekf", "office-6", 100.0, 100.0)
    failed = row("smoother", "office-6", None, None, status="failed")
    (case,) = cases_of([*six, alone, failed], {"odometry,rfid": "tags"})
    assert cells(ratios([case]))[0][2].startswith("0.500")
    assert [line[1] for line in cells(accuracy([case]))] == ["EKF", "smoother"]


def test_aligned_errors_are_shown_where_a_map_was_estimated(six):
    aligned = [one | {"aligned.position_rmse": 0.01} for one in six]
    (_, smoother) = cells(accuracy([Case("landmarks", aligned)]))
    assert smoother[-1] == "0.010"
    assert cells(ratios([Case("landmarks", aligned)]))[0][-1] == "1.000 (1.000 to 1.000)"


def test_recordings_stand_each_by_itself(six):
    found = Case("ranges", six).of_logs()
    assert [case.name for case in found] == [f"office-{i}" for i in range(6)]
    assert all(case.labels == ["ekf", "smoother"] for case in found)


def test_the_picture_has_a_mark_for_each_ratio(six):
    figure = picture([Case("tags", six), Case("few", six[:1] + six[6:7])])
    for axis in figure.axes:
        marks = [line.get_xdata()[0] for line in axis.lines if line.get_marker() == "o"]
        assert marks == pytest.approx([0.5, 0.5] if axis is figure.axes[0] else [1 / 3, 1 / 3])


def test_tables_are_made_from_the_runs_of_an_experiment(tmp_path):
    (tmp_path / "room.toml").write_text(ROOM)
    (tmp_path / "tiny.toml").write_text(TINY)
    names = {"odometry,bearing_range": "landmarks", "odometry,rfid": "tags"}
    prepared = prepare(tmp_path / "tiny.toml", out=tmp_path / "out")
    done = run_experiment(prepared, jobs=1)
    assert not done.failures
    cases = cases_of(done.rows.to_dicts(), names)
    found = cells(accuracy(cases))
    assert [line[:2] for line in found] == [[name, label] for name in names.values() for label in ("EKF", "smoother")]
    assert all(0.0 < float(cell) < 0.5 for line in found for cell in (line[2], line[4]))
    assert all(0.5 < float(cell) < 2.0 for line in cells(ratios(cases)) for cell in line[2:])
    seconds = cells(times(seconds_per_minute(prepared, names)))
    assert [line[0] for line in seconds] == ["landmarks", "tags"]
    assert all(float(cell) > 0.0 for line in seconds for cell in line[1:])


@pytest.mark.parametrize("name", NAMES)
def test_each_experiment_has_the_sensors_of_its_section_and_is_on_the_page(name):
    experiment = read_experiment(FILES / f"{name}.toml")
    assert experiment.name == name
    assert experiment.report.baseline == "smoother"
    (names,) = (experiments[name] for experiments in SECTIONS.values() if name in experiments)
    assert [",".join(sensors or ()) for sensors in experiment.sensors] == list(names)
    for log in experiment.logs:
        if log.simulate is not None:
            assert named_settings(str(FILES / log.simulate)).drive.duration == 240.0
    assert f"{name}.toml" in PAGE.read_text()


def test_the_page_has_a_place_for_each_table():
    page = PAGE.read_text()
    for section in (*SECTIONS, "processor-time"):
        page = with_tables(page, section, ["| new |", ""])
    assert page.count("| new |") == len(SECTIONS) + 1

"""Every estimator on every sensor gives the results that are stored; ``scripts/golden renew`` stores them anew."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from changed_logs import with_rig
from regression import commands, logs
from regression.commands import RESULTS, is_present
from regression.differences import differences, size_of
from regression.records import Record, read_records, record_run, write_records
from regression.scenarios import SCENARIOS
from regression.tolerances import TOLERANCE, beyond_processors
from scripts_here import run_script

from factorgraph_loc.experiments.run import RunConfig

CASES = [(name, label) for name, scenario in SCENARIOS.items() for label in scenario.cases()]
MOST_BYTES = 1_000_000

stored = cache(lambda name: read_records(RESULTS / f"{name}.json"))


@pytest.mark.parametrize(("name", "label"), CASES, ids=lambda part: part)
def test_results_are_the_stored_ones(name, label):
    scenario = SCENARIOS[name]
    if not is_present(scenario):
        pytest.skip(f"FGLOC_DATA names no folder with {scenario.data}")
    case, old, new = f"{name}/{label}", stored(name)[label], scenario.record(label)
    found = beyond_processors(case, old, new)
    assert not found, commands.described(case, found, old, new)


def test_what_is_stored_is_small_and_belongs_to_a_case():
    assert {path.stem for path in RESULTS.iterdir()} == set(SCENARIOS)
    assert [(name, label) for name in SCENARIOS for label in stored(name)] == CASES
    assert sum(path.stat().st_size for path in RESULTS.iterdir()) < MOST_BYTES


@pytest.mark.parametrize("name", ["ekf", "particle_filter", "smoother", "batch"])
def test_a_change_of_a_model_by_a_hundredth_is_seen(name):
    log, config = logs.landmarks(), RunConfig(name, {"particles": 300} if name == "particle_filter" else {})
    right = record_run(log, config)
    for sensor, key, value in (
        ("odometry", "scale_distance", 1.01),
        ("bearing_range", "range_sigma", 0.101),
        ("bearing_range", "bearing_sigma", 0.0303),
    ):
        found = differences(right, record_run(with_rig(log, sensor, **{key: value}), config))
        seen = {difference.quantity: difference.size for difference in found}
        assert min(seen["final.poses"], seen["final.covariances"]) > 30.0 * TOLERANCE, key


def test_records_are_read_as_they_were_written(tmp_path):
    old = Record(
        {"events": ["lost"], "final": 2}, {"final.poses": np.array([[1.0 / 3.0, np.nan, 0.0]])}, {"error": 0.5}
    )
    write_records(tmp_path / "all.json", {"ekf": old})
    write_records(tmp_path / "some.json", {"ekf": old}, 8)
    assert not differences(old, read_records(tmp_path / "all.json")["ekf"])
    (difference,) = differences(old, read_records(tmp_path / "some.json")["ekf"])
    assert 1e-10 < difference.size < 1e-8


@pytest.mark.parametrize(
    ("name", "old", "new", "size"),
    [
        ("final.poses", [[0.0, 0.0, 3.1]], [[0.0, 0.0, 3.1 - 2.0 * np.pi]], 0.0),
        ("final.poses", [[1.0, 0.0, 0.0]], [[1.0, 1e-3, 0.0]], 1e-3),
        ("final.t", [100.0], [101.01], 0.01),
        ("final.covariances", [[4.0, 0.0, 1.0]], [[4.0, 0.02, 1.0]], 0.01),
        ("final.covariances", [[0.0, 0.0, 1.0]], [[0.0, 0.0, 1.0]], 0.0),
        ("final.covariances", [[0.0, 0.0, 1.0]], [[1e-9, 0.0, 1.0]], np.inf),
        ("learnt.constants", [[0.3, 0.1]], [[0.304, 0.1]], 0.01),
        ("final.poses", [[1.0, 0.0, 0.0]], [[np.nan, 0.0, 0.0]], np.inf),
        ("final.t", [1.0], [1.0, 2.0], np.inf),
        ("final.t", [], [], 0.0),
    ],
)
def test_sizes_of_differences(name, old, new, size):
    assert size_of(name, np.array(old), np.array(new)) == pytest.approx(size, abs=1e-12)


@pytest.mark.parametrize(
    ("quantity", "off", "held"),
    [
        ("final.poses", 0.5, True),
        ("final.poses", 1.5, False),
        ("causal.poses", 1e-7, True),
        ("causal.poses", 1e-5, False),
    ],
)
def test_where_a_case_branches_only_what_depends_on_it_is_held_less_closely(quantity, off, held):
    """Poses of a drawn trajectory by their standard deviation, here 0.2."""
    kind = quantity.partition(".")[0]
    numbers = {quantity: np.zeros((2, 3)), f"{kind}.covariances": np.tile(0.04 * np.eye(3)[np.triu_indices(3)], (2, 1))}
    old, new = (Record({}, {**numbers, quantity: np.full((2, 3), x)}) for x in (0.0, off * (0.2 if off > 0.1 else 1.0)))
    assert (beyond_processors("points/particle_filter", old, new) == []) == held
    assert beyond_processors("points/smoother", old, new) or off < TOLERANCE


def test_results_are_renewed_where_they_changed(tmp_path, monkeypatch):
    name = "landmarks-bearings"
    monkeypatch.setattr(commands, "RESULTS", tmp_path)
    monkeypatch.setattr(commands, "SCENARIOS", {name: SCENARIOS[name]})
    (tmp_path / "gone.json").write_text("{}")
    first = commands.renew([])
    assert first[0] == "gone: removed"
    assert first[1:] == [f"{name}/{label}: new" for label in SCENARIOS[name].cases()]
    assert [path.stem for path in tmp_path.iterdir()] == [name]
    records = read_records(tmp_path / f"{name}.json")
    assert commands.renew([]) == []
    off = {**records["ekf"].numbers, "final.poses": records["ekf"].numbers["final.poses"] + 1e-3}
    write_records(tmp_path / f"{name}.json", {**records, "ekf": replace(records["ekf"], numbers=off)}, 8)
    (line,) = commands.renew([])
    assert line.startswith(f"{name}/ekf: final.poses differs by 1.0e-03; causal.position_rmse 0.")
    assert commands.renew([]) == []


def test_the_command(tmp_path, capsys):
    for action, told in (("write", ""), ("compare", "nothing differs\n")):
        assert run_script("golden", action, tmp_path, "--long", "--only", "landmarks-bearings") == 0
        assert capsys.readouterr().out == told

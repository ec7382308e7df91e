"""What an experiment's file may say, and what is said of one that is wrong."""

import re
from pathlib import Path

import pytest
from refusal import refusal

from factorgraph_loc.experiments.experiment_file import MOST_RUNS, Sweep, read_experiment

GOOD = """
name = "lags"
logs = ["plaza2", {simulate = "office", seeds = "0:3"}]
estimators = ["ekf", {name = "smoother", label = "short", settings = {lag = 2}}]
seeds = "0:2"
"""


@pytest.fixture
def read(tmp_path):
    """``read(text, *changes)``: the experiment of a file with this text."""

    def read_text(text, *changes):
        file = tmp_path / "a.toml"
        file.write_text(text)
        return read_experiment(file, dict(changes))

    return read_text


def test_a_grid_takes_every_value_with_every_other_and_a_list_the_first_with_the_first():
    over = {"a.x": [1, 2], "b.y": ["u", "v"]}
    assert len(Sweep.model_validate(over).points()) == 4
    in_step = Sweep.model_validate(over | {"mode": "list"}).points()
    assert in_step == [{"a.x": 1, "b.y": "u"}, {"a.x": 2, "b.y": "v"}]


def test_changes_reach_keys_estimators_and_simulated_logs(read):
    experiment = read(
        GOOD, ("seeds", 7), ("report.baseline", "ekf"), ("short.lag", 5), ("smoother.relinearize", True),
        ("simulation.drive.duration", 20), ("sweep.short.lag", [1, 2]),
    )  # fmt: skip
    assert experiment.seeds == (7,)
    assert experiment.report.baseline == "ekf"
    assert experiment.estimators[0].settings == {}
    assert experiment.estimators[1].settings == {"lag": 5, "relinearize": True}
    assert experiment.logs[1].settings == {"drive": {"duration": 20}}
    assert experiment.sweep.over == {"short.lag": (1, 2)}


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        ("sedes = 1", ["sedes", "did you mean seeds?"]),
        ("[sweep]\n'smother.lag' = [1]", ["smother.lag", "did you mean smoother?"]),
        ("[sweep]\nmode = 'list'\n'short.lag' = [1]\n'ekf.max_delay' = [1, 2]", ["equal numbers of values"]),
        ("seeds = '5:2'", ["seeds", "5:2", "0:10"]),
        ("logs = [{simulate = 'office', rig = 'a.rig.toml'}]", ["rig", "simulate"]),
        ("seeds = '0:1000000000'", ["seeds", "10,000 seeds"]),
        ("[sweep]\n" + "\n".join(f"short.x{i} = [1]" for i in range(60)), ["60 settings", "at most 50"]),
    ],
)
def test_what_is_wrong_is_one_line_with_key_and_value(read, text, fragments):
    key = text.partition(" = ")[0].strip("[]")
    kept = "\n".join(line for line in GOOD.splitlines() if not line.startswith(f"{key} ="))
    refusal(lambda: read(f"{kept}\n{text}"), "a.toml", *fragments)


def test_of_a_large_sweep_no_more_points_are_made_than_runs_are_allowed():
    large = Sweep.model_validate({f"a.k{i}": list(range(10_000)) for i in range(50)})
    assert len(large.points()) == MOST_RUNS + 1


def test_the_file_of_the_documentation_is_one(read):
    page = Path(__file__).parents[2] / "docs" / "experiments.md"
    (text,) = re.findall(r"```toml\n(.*?)```", page.read_text(), re.DOTALL)
    experiment = read(text)
    assert len(experiment.sweep.points()) == 4
    assert experiment.report.baseline == "ekf"

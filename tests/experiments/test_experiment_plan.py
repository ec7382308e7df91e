"""Which runs an experiment has, and what their keys depend on."""

import dataclasses
import subprocess
import sys

import pytest

from factorgraph_loc import InputError, write_native
from factorgraph_loc.experiments import keys
from factorgraph_loc.experiments import plan as plan_module
from factorgraph_loc.experiments.experiment_file import Experiment
from factorgraph_loc.experiments.plan import plan


@pytest.fixture
def logs(tmp_path, log):
    """A folder with two native logs, ``one`` and ``two``."""
    for name in ("one", "two"):
        write_native(dataclasses.replace(log, name=name), tmp_path / "logs" / name)
    return tmp_path / "logs"


@pytest.fixture
def planned(logs, tmp_path):
    """``planned(**content)``: the runs of an experiment with other keys than the usual ones."""

    def make(**content):
        usual = {"name": "a", "logs": ["one", "two"], "estimators": ["dead_reckoning"]}
        return plan(Experiment.model_validate(usual | content), logs, tmp_path)

    return make


def test_a_glob_stands_for_all_logs_of_a_folder_and_for_known_names(planned):
    assert [run.log for run in planned(logs=["[ot]*"])] == ["one", "two"]
    assert {run.log for run in planned(logs=["plaza*"])} == {"plaza1", "plaza2"}
    with pytest.raises(InputError, match=r"no log matches 'thre\*'"):
        planned(logs=["thre*"])


@pytest.mark.parametrize(
    ("glob", "found"),
    [
        ("./**", ["one", "two"]),
        ("./*", ["one", "two"]),
        ("../logs/t?o", ["two"]),
        ("**/one", ["one"]),
        ("./**/run.toml", ["one", "two"]),
    ],
)
def test_globs_go_through_folders(planned, glob, found):
    assert [run.log for run in planned(logs=[glob])] == found


@pytest.fixture
def outside(tmp_path, logs):
    """A folder beside that of the experiment, with a log, a rig and a simulation."""
    folder = tmp_path / "outside"
    folder.mkdir()
    (logs / "two").rename(folder / "two")
    (folder / "a.rig.toml").write_text("")
    (folder / "a.toml").write_text("")
    return folder


@pytest.mark.parametrize(
    "entry",
    [
        "../outside/two",
        "../outside/*",
        "linked",
        {"log": "one", "rig": "../outside/a.rig.toml"},
        {"simulate": "../outside/a.toml"},
    ],
)
def test_an_experiment_leads_to_its_own_folder_or_below_the_data_folder(planned, logs, outside, entry, monkeypatch):
    monkeypatch.delenv("FGLOC_DATA", raising=False)
    (logs / "linked").symlink_to(outside / "two")
    if isinstance(entry, str):
        entry = entry.format(outside=outside)
    else:
        entry = {key: value.format(outside=outside) for key, value in entry.items()}
    with pytest.raises(InputError, match=r"logs: path .* leaves its folder .*\(--data-root, FGLOC_DATA\)"):
        planned(logs=[entry])


@pytest.mark.parametrize("entry", ["../outside/two", "{outside}/two", "two", "../outside/*", "linked"])
def test_an_experiment_may_name_logs_below_the_data_folder(planned, logs, outside, entry, monkeypatch):
    monkeypatch.setenv("FGLOC_DATA", str(outside))
    (logs / "linked").symlink_to(outside / "two")
    if "*" in entry:
        with pytest.raises(InputError, match="leaves its folder"):  # the glob begins above the data folder
            planned(logs=[entry.replace("outside/", "")])
    assert [run.log for run in planned(logs=[entry.format(outside=outside)])] == ["two"]


@pytest.mark.parametrize(
    "content",
    [
        {"estimators": ["particle_filter"], "seeds": range(10_000), "sensors": [["odometry"]] * 300},
        {
            "logs": [{"simulate": "office", "seeds": range(10_000)}],
            "sweep": {"simulation.world.tags": list(range(10_000))},
        },
        {"sweep": {f"dead_reckoning.k{i}": list(range(10_000)) for i in range(50)}},
    ],
)
def test_runs_are_counted_before_any_is_planned(planned, content, monkeypatch):
    monkeypatch.setattr(plan_module, "_runs", lambda *_: pytest.fail("was planned"))
    monkeypatch.setattr(plan_module, "_logs", lambda *_: pytest.fail("a log was looked at"))
    with pytest.raises(InputError, match="more than 100,000"):
        planned(**content)


def test_seeds_are_for_estimators_that_are_random(planned):
    runs = planned(logs=["one"], estimators=["ekf", "particle_filter"], seeds=[3, 4])
    assert [(run.label, run.seed) for run in runs] == [("ekf", 3), ("particle_filter", 3), ("particle_filter", 4)]


def test_a_sweep_concerns_the_estimators_that_it_names_and_simulated_logs(planned):
    simulated = {"simulate": "office", "settings": {"drive": {"duration": 5}}}
    sweep = {"short.lag": [1, 2], "simulation.world.tags": [10, 20]}
    estimators = ["ekf", {"name": "smoother", "label": "short"}]
    runs = planned(logs=["one", simulated], estimators=estimators, sweep=sweep)
    by_log = {log: [(r.label, dict(r.sweep)) for r in runs if r.log == log] for log in ("one", "office-0")}
    assert by_log["one"] == [("ekf", {}), ("short", {"short.lag": 1}), ("short", {"short.lag": 2})]
    assert len(by_log["office-0"]) == 2 + 4
    assert [r.settings for r in runs if r.label == "short"][:2] == [{"lag": 1}, {"lag": 2}]
    assert len({r.key for r in runs}) == len(runs)


def test_a_second_plan_has_the_same_keys_without_numerical_libraries(planned, logs, tmp_path):
    before = planned(logs=["one"], estimators=["ekf", "particle_filter"], prior="reference")
    script = (
        "import sys, pathlib\n"
        "from factorgraph_loc.experiments.experiment import plan, Experiment\n"
        "e = Experiment(name='a', logs=['one'], estimators=['ekf', 'particle_filter'], prior='reference')\n"
        f"print(*(r.key for r in plan(e, pathlib.Path({str(logs)!r}), pathlib.Path({str(tmp_path)!r}))))\n"
        "print(*{'numpy', 'gtsam', 'polars', 'numba'} & set(sys.modules))\n"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert said.splitlines() == [" ".join(run.key for run in before), ""]


def test_a_key_changes_with_everything_that_a_result_depends_on(planned, logs, monkeypatch):
    def key(**content):
        (run,) = planned(logs=["one"], **content)
        return run.key

    found = [
        key(),
        key(estimators=["ekf"]),
        key(estimators=[{"name": "ekf", "settings": {"max_delay": 0.4}}]),
        key(sensors=["odometry"]),
        key(prior="0,0,0"),
        key(seeds=[1]),
        key(max_gap=0.3),
    ]
    with (logs / "one" / "odometry.csv").open("a") as file:
        file.write("1700000099000000000,0,0\n")
    found.append(key())
    for name, value in (("code_version", "x"), ("library_versions", {"gtsam": "9"})):
        monkeypatch.setattr(keys, name, lambda value=value: value)
        found.append(key())
    assert len(set(found)) == len(found)


def test_a_key_does_not_change_with_what_a_result_does_not_depend_on(planned, logs, monkeypatch):
    monkeypatch.setenv("FGLOC_DATA", str(logs.parent))
    (before,) = planned(logs=["one"])
    for file in (logs / "one").iterdir():
        file.touch()
    moved = logs.rename(logs.parent / "elsewhere")
    (after,) = planned(logs=[str(moved / "one")])
    assert after.key == before.key
    # said with other words: the default is the same setting
    delay = planned(logs=[str(moved / "one")], estimators=["ekf"])[0].key
    assert (
        planned(logs=[str(moved / "one")], estimators=[{"name": "ekf", "settings": {"max_delay": 0.5}}])[0].key == delay
    )


def test_the_rig_and_the_map_that_are_given_are_part_of_the_log(planned, logs):
    rig, world = (next((logs / "one").glob(f"*.{kind}.toml")) for kind in ("rig", "world"))
    (own,) = planned(logs=["one"])
    (given,) = planned(logs=[{"log": "one", "rig": str(rig), "world": str(world)}])
    world.write_text(world.read_text() + "\n")
    (changed,) = planned(logs=[{"log": "one", "rig": str(rig), "world": str(world)}])
    assert len({own.key, given.key, changed.key}) == 3

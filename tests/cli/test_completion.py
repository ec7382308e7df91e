"""What the shell completes, and that it does not make people wait."""

import os
import subprocess
import sys

import pytest

from factorgraph_loc import plugins
from factorgraph_loc.cli import completion
from factorgraph_loc.files.settings import settings_in
from factorgraph_loc.files.shipped import manifests
from factorgraph_loc.planning.policies import policy
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.simulation import PRESETS, SimulationSettings

FGLOC = [sys.executable, "-c", "from factorgraph_loc.cli.main import main; main()"]


def completed(line: str) -> list[str]:
    """What bash would be given for the last word of a line."""
    words = line.split(" ")
    about = {"_FGLOC_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    command = [sys.executable, "-c", "import sys; sys.argv[0] = 'fgloc'\n" + FGLOC[2]]
    done = subprocess.run(command, env=os.environ | about, capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_the_names_are_those_of_the_registries():
    assert list(plugins.PRESETS) == list(PRESETS)
    assert all(policy(name) for name in plugins.POLICIES)
    assert completion.logs("") == list(manifests())


def test_the_settings_of_simulations_and_active_runs_are_those_of_the_models():
    keys = {s.key for s in settings_in(SimulationSettings) if not s.key.startswith("rig.")}
    assert {key.removesuffix("=") for key in completion.simulation_setting("")} == keys
    found = completion.active_setting("")
    assert {key.removesuffix("=") for key in found} == keys | {s.key for s in settings_in(ActiveSettings)}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("fgloc simu", ["simulate"]),
        ("fgloc compare plaza2 -e ekf,smoother,s", ["ekf,smoother,switching"]),
        ("fgloc run no-such-log", []),  # the shell goes on with files
    ],
)
def test_a_shell_completes_words(line, expected):
    assert completed(line) == expected


@pytest.mark.parametrize(
    ("complete", "word", "expected"),
    [
        ("logs", "mrclam6-robot", ["mrclam6-robot1", "mrclam6-robot3", "mrclam6-robot5"]),
        (
            "setting",
            "particle_filter.smoothing",
            ["particle_filter.smoothing_trajectories=", "particle_filter.smoothing_interval="],
        ),
        ("sensors", "odometry,rfid,r", ["odometry,rfid,rssi"]),
        ("reader", "m", ["mapped", "mrclam"]),
        ("simulation_setting", "world.ta", ["world.tags=", "world.tag_height="]),
        ("policies", "random,p", ["random,paper_literal", "random,patrol"]),
    ],
)
def test_words_of_options_are_completed(complete, word, expected):
    assert getattr(completion, complete)(word) == expected


def test_completion_loads_no_numerical_libraries():
    code = (
        "import sys, factorgraph_loc.cli.app\n"
        "from factorgraph_loc.cli import completion\n"
        "assert completion.logs('plaza') and completion.estimators('ekf,') and completion.preset('')\n"
        "assert completion.setting('smo') and completion.reader('m')\n"
        "print(sorted({'numpy', 'gtsam', 'polars', 'scipy', 'pydantic'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"

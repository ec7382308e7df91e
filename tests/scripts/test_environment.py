"""``scripts/environment.sh`` installs an extra once, whatever else is installed."""

import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture
def installs(tmp_path):
    """``installs("[test]")``: whether the extra is installed, into an environment whose programs are stand-ins."""
    shutil.copy(SCRIPTS / "environment.sh", tmp_path)
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).write_text("")
    (tmp_path / ".venv/bin").mkdir(parents=True)
    for name in ("pip", "python"):
        (tmp_path / ".venv/bin" / name).write_text('#!/bin/sh\necho "$*"\n')
        (tmp_path / ".venv/bin" / name).chmod(0o755)

    def run(extra):
        command = ["bash", "-euo", "pipefail", "-c", f'source ./environment.sh "{extra}"']
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        assert done.stderr == ""
        return done.stdout.strip().endswith(f"-e .{extra}")

    return run


def test_an_extra_is_installed_once(installs):
    extras = ("", "[release]", "[test]")
    assert [installs(extra) for extra in extras] == [True, True, True]
    assert [installs(extra) for extra in extras] == [False, False, False]


def test_an_environment_for_tests_serves_the_demo_alone(installs):
    assert [installs(extra) for extra in ("[test]", "", "[release]")] == [True, False, True]


def test_what_the_project_asks_for_has_changed(installs, tmp_path):
    assert installs("[test]")
    (tmp_path / "constraints.txt").write_text("numpy==2.0\n")
    assert installs("[test]")
    (tmp_path / "constraints.txt").write_text("")
    assert installs("[test]")

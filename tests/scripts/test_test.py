"""``scripts/test`` makes every check, also when one fails, and names those that failed."""

import hashlib
import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"
PROGRAMS = ("ruff", "mypy", "sphinx-build", "pytest", "python", "pip")


@pytest.fixture
def checked(tmp_path):
    """``checked("mypy")``: the lines that the script prints, and its exit code, where these programs fail; all are stand-ins that
    say how they were called."""
    (tmp_path / "scripts").mkdir()
    for name in ("test", "environment.sh"):
        shutil.copy(SCRIPTS / name, tmp_path / "scripts")
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests/test_rounding.py").write_text("pytestmark = pytest.mark.kernels\n")
    (tmp_path / "tests/test_words.py").write_text("")
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).write_text("")
    (tmp_path / ".venv/bin").mkdir(parents=True)
    wanted = hashlib.sha256(b"").hexdigest()
    (tmp_path / ".venv/installed").write_text(f"{wanted}[test]\n")

    def run(*failing, arguments=()):
        for name in PROGRAMS:
            program = tmp_path / ".venv/bin" / name
            program.write_text(f'#!/bin/sh\necho "{name} $*"\nexit {int(name in failing)}\n')
            program.chmod(0o755)
        done = subprocess.run([tmp_path / "scripts/test", *arguments], capture_output=True, text=True, check=False)
        assert done.stderr == ""
        return done.stdout.splitlines(), done.returncode

    return run


def test_all_is_well(checked):
    lines, code = checked(arguments=["tests/io", "-k", "read"])
    assert code == 0
    assert [line for line in lines if line in ("ruff check .", "ruff format --check .", "mypy ")] == [
        "ruff check .",
        "ruff format --check .",
        "mypy ",
    ]
    assert any(line.startswith("sphinx-build ") for line in lines)
    assert "pytest -m kernels tests/test_rounding.py" in lines
    assert lines[-1] == "pytest -n 2 --dist worksteal tests/io -k read"


@pytest.mark.parametrize("program", ["ruff", "mypy", "sphinx-build", "pytest"])
def test_what_fails_is_named_and_the_rest_is_done(checked, program):
    lines, code = checked(program)
    assert code == 1
    assert sum(line.split()[0] in PROGRAMS for line in lines) == 6
    names = {"ruff": ["ruff check", "ruff format"], "mypy": ["mypy"], "sphinx-build": ["documentation"]}
    failed = [line.removeprefix("FAILED: ") for line in lines if line.startswith("FAILED: ")]
    assert [name for name in failed if not name.startswith("pytest with")] == names.get(program, [])
    assert (program == "pytest") == any(name.startswith("pytest with") for name in failed)

"""Scripts of this project, run as by a shell but in the process of the tests, which need not import everything again."""

import sys
from pathlib import Path
from runpy import run_path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"


def run_script(script: str | Path, *arguments: object) -> int:
    """Run one by name or path; its exit code. A message to exit with is raised, as are errors."""
    path = str(SCRIPTS / script)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [path, *map(str, arguments)])
        patch.setattr(sys, "path", sys.path.copy())
        patch.setenv("MPLBACKEND", "Agg")
        try:
            run_path(path, run_name="__main__")
        except SystemExit as end:
            if isinstance(end.code, str):
                raise
            return int(end.code or 0)
    return 0

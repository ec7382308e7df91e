"""A sensor of another package is used like ours, without a change of any file of this project."""

import os
import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "docs/adding-a-sensor.md"


def test_the_page_of_the_docs_shows_the_files_of_the_package():
    shown = re.findall(r"```python\n# (\S+)\n\n?(.*?)```", PAGE.read_text(), re.DOTALL)
    assert shown
    for name, text in shown:
        assert text.strip() in (HERE / "package" / name).read_text()


def test_a_sensor_of_another_package_is_used_like_ours():
    paths = [str(HERE / "package"), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(HERE / "with_compass.py")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, cwd=HERE.parents[1])
    assert done.returncode == 0, done.stdout + done.stderr
    assert ".." in done.stdout

"""What a first run says before it compiles."""

import io
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from factorgraph_loc.cli import show
from factors.odometry import kernels


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(kernels, "relative", SimpleNamespace(stats=SimpleNamespace(cache_path=str(tmp_path))))
    return tmp_path


@pytest.mark.parametrize(
    ("stream", "compiled", "told"), [(Terminal, False, 1), (Terminal, True, 0), (io.StringIO, False, 0)]
)
def test_a_terminal_is_told_that_the_first_use_compiles(cache, monkeypatch, stream, compiled, told):
    if compiled:
        (cache / "kernels.relative-21.py311.nbi").touch()
    monkeypatch.setattr(sys, "stderr", stream())
    show.first_use()
    assert sys.stderr.getvalue().count("\n") == told


USE = """
import numpy as np
from factorgraph_loc.cli import show
from factors.odometry.kernels import relative
from factors.odometry.model import OdometryModel
import sys
sys.stderr.isatty = lambda: True
show.first_use()
relative(np.array(OdometryModel().noise()), (0.0,) * 8, (1.0,) * 8)
show.first_use()
"""


def test_what_is_compiled_is_found(tmp_path):
    cache = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", USE], env=cache, capture_output=True, text=True, check=True)
    assert done.stderr == "the first use compiles for up to a minute; later ones do not\n"

"""What a first run says before it compiles."""

import os
import subprocess
import sys

USE = """
import numpy as np
from factorgraph_loc.cli import show
from factors.odometry.kernels import relative
from factors.odometry.model import OdometryModel
show.first_use()
relative(np.array(OdometryModel().noise()), (0.0,) * 8, (1.0,) * 8)
show.first_use()
"""


def test_the_first_use_announces_once_that_it_compiles(tmp_path):
    cache = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", USE], env=cache, capture_output=True, text=True, check=True)
    assert done.stderr == "the first use of fgloc compiles functions, for up to a minute\n"

"""What the tests of the scripts share."""

import sys
from pathlib import Path

from straight_log import log  # noqa: F401 - a fixture

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))

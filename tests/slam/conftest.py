"""What the tests of what maps while it localizes share: figures that the benchmarks print are theirs too."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts/benchmarks"))

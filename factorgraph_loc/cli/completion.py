"""What the shell completes: names of logs, estimators and presets. Nothing here may load numerical libraries: a key was pressed."""

from factorgraph_loc.files.shipped import manifests
from factorgraph_loc.plugins import ESTIMATORS

# said again here, as the module that knows them loads much; a test compares
PRESETS = ("office", "sparse", "bursty", "corridor", "warehouse", "symmetric")
PRIORS = ("reference", "log", "unknown")


def logs(incomplete: str) -> list[str]:
    """Names that `fgloc datasets` lists; where none begins so, the shell goes on with files."""
    return [name for name in manifests() if name.startswith(incomplete)]


def estimator(incomplete: str) -> list[str]:
    """An estimator's name."""
    return [name for name in ESTIMATORS if name.startswith(incomplete)]


def estimators(incomplete: str) -> list[str]:
    """Names of estimators with commas between them: the last one is completed, to one that is not there yet."""
    before, comma, last = incomplete.rpartition(",")
    there = before.split(",")
    return [f"{before}{comma}{name}" for name in estimator(last) if name not in there]


def preset(incomplete: str) -> list[str]:
    """A preset of simulations."""
    return [name for name in PRESETS if name.startswith(incomplete)]


def prior(incomplete: str) -> list[str]:
    """A word for where a run starts."""
    return [name for name in PRIORS if name.startswith(incomplete)]


def setting(incomplete: str) -> list[str]:
    """The estimator of a setting NAME.KEY=VALUE."""
    return [f"{name}." for name in estimator(incomplete)]

"""Shell completion of logs, estimators and presets. It must be fast, so no numerical libraries may be imported here."""

from factorgraph_loc.files.shipped import manifests
from factorgraph_loc.plugins import ESTIMATORS

# repeated here, because the module that defines them is slow to import; a test compares them
PRESETS = ("office", "sparse", "bursty", "corridor", "warehouse", "symmetric")
PRIORS = ("reference", "log", "unknown")


def logs(incomplete: str) -> list[str]:
    """Names that `fgloc datasets` lists; without a match the shell completes file names."""
    return [name for name in manifests() if name.startswith(incomplete)]


def estimator(incomplete: str) -> list[str]:
    """An estimator's name."""
    return [name for name in ESTIMATORS if name.startswith(incomplete)]


def estimators(incomplete: str) -> list[str]:
    """Comma-separated names of estimators: completes the last one, without repetition."""
    before, comma, last = incomplete.rpartition(",")
    there = before.split(",")
    return [f"{before}{comma}{name}" for name in estimator(last) if name not in there]


def preset(incomplete: str) -> list[str]:
    """A simulation preset."""
    return [name for name in PRESETS if name.startswith(incomplete)]


def prior(incomplete: str) -> list[str]:
    """A keyword for the start of a run."""
    return [name for name in PRIORS if name.startswith(incomplete)]


def setting(incomplete: str) -> list[str]:
    """The estimator name of a setting NAME.KEY=VALUE."""
    return [f"{name}." for name in estimator(incomplete)]

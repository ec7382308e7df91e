"""The manifests, rigs and reader descriptions that are installed with the package. For fast shell completion, this
module imports no numerical library."""

from importlib import resources
from pathlib import Path

OTHERS = (".rig.toml", ".world.toml", ".reader.toml")  # suffixes of TOML files that are not manifests


def manifests() -> dict[str, Path]:
    """Return the files that describe the data sets of this package, by the name of the data set."""
    return {file.stem: file for file in sorted(folder().glob("*.toml")) if not file.name.endswith(OTHERS)}


def rigs() -> dict[str, Path]:
    """Return the rig files in this package by name. A rig file has the settings of a robot and its sensors."""
    return {file.name.removesuffix(".rig.toml"): file for file in sorted(folder().glob("*.rig.toml"))}


def readers() -> dict[str, Path]:
    """Return the files with settings for tables of known programs, by the name of the reader of these tables."""
    return {file.name.removesuffix(".reader.toml"): file for file in sorted(folder().glob("*.reader.toml"))}


def folder() -> Path:
    """Return the folder ``datasets`` of the installed package. In a source checkout it is next to the package."""
    package = Path(str(resources.files(__name__.partition(".")[0])))
    installed = package / "datasets"
    return installed if installed.is_dir() else package.parent / "datasets"

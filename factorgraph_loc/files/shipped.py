"""The manifests, rigs and reader descriptions that are installed with the package. For fast shell completion, this
module imports no numerical library."""

from importlib import resources
from pathlib import Path

OTHERS = (".rig.toml", ".world.toml", ".reader.toml")  # suffixes of TOML files that are not manifests


def manifests() -> dict[str, Path]:
    """Return the installed manifests: the file by name, sorted by name."""
    return {file.stem: file for file in sorted(folder().glob("*.toml")) if not file.name.endswith(OTHERS)}


def rigs() -> dict[str, Path]:
    """Return the installed rigs: the file by name, sorted by name."""
    return {file.name.removesuffix(".rig.toml"): file for file in sorted(folder().glob("*.rig.toml"))}


def readers() -> dict[str, Path]:
    """Return the installed reader descriptions: the file by name, sorted by name.

    A reader description has the settings for reading the tables of a known program.
    """
    return {file.name.removesuffix(".reader.toml"): file for file in sorted(folder().glob("*.reader.toml"))}


def folder() -> Path:
    """Return the folder ``datasets`` of the installed package. In a source checkout it is next to the package."""
    package = Path(str(resources.files(__name__.partition(".")[0])))
    installed = package / "datasets"
    return installed if installed.is_dir() else package.parent / "datasets"

"""The shipped manifests, rigs and descriptions of readers. Importable without numerical libraries, for shell completion."""

from importlib import resources
from pathlib import Path

OTHERS = (".rig.toml", ".world.toml", ".reader.toml")  # endings of TOML files that are no data sets


def manifests() -> dict[str, Path]:
    """The shipped manifests: name -> file, sorted by name."""
    return {file.stem: file for file in sorted(folder().glob("*.toml")) if not file.name.endswith(OTHERS)}


def rigs() -> dict[str, Path]:
    """The shipped rigs: name -> file, sorted by name."""
    return {file.name.removesuffix(".rig.toml"): file for file in sorted(folder().glob("*.rig.toml"))}


def readers() -> dict[str, Path]:
    """The shipped descriptions of readers, manifests of the reader ``mapped`` without data: name -> file, sorted by name."""
    return {file.name.removesuffix(".reader.toml"): file for file in sorted(folder().glob("*.reader.toml"))}


def folder() -> Path:
    """The folder of shipped files: inside the installed package, or next to the package in a source checkout."""
    package = Path(str(resources.files(__name__.partition(".")[0])))
    installed = package / "datasets"
    return installed if installed.is_dir() else package.parent / "datasets"

"""Locations of the shipped manifests and rigs. Importable without numerical libraries, for shell completion."""

import sysconfig
from pathlib import Path

SHIPPED = Path("share", "factorgraph-loc", "datasets")  # relative to the data path of an installation


def manifests() -> dict[str, Path]:
    """The shipped manifests: name -> file, sorted by name."""
    for folder in manifest_folders():
        found = {
            file.stem: file
            for file in sorted(folder.glob("*.toml"))
            if not file.name.endswith((".rig.toml", ".world.toml"))
        }
        if found:
            return found
    return {}


def rigs() -> dict[str, Path]:
    """The shipped rigs: name -> file, sorted by name."""
    for folder in manifest_folders():
        if found := {file.name.removesuffix(".rig.toml"): file for file in sorted(folder.glob("*.rig.toml"))}:
            return found
    return {}


def manifest_folders() -> list[Path]:
    """Folders of shipped manifests: next to the package in a source checkout, else in the installation's data path."""
    checkout = Path(__file__).resolve().parents[2]
    folders = [checkout / "datasets"] if (checkout / "pyproject.toml").is_file() else []
    user = sysconfig.get_path("data", sysconfig.get_preferred_scheme("user"))
    return [*folders, Path(sysconfig.get_path("data")) / SHIPPED, Path(user) / SHIPPED]

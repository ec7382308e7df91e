"""Where the manifests lie that ship with the project. Importable without numerical libraries, for the completion of shells."""

import sysconfig
from pathlib import Path

SHIPPED = Path("share", "factorgraph-loc", "datasets")  # below the data path of an installation


def manifests() -> dict[str, Path]:
    """The manifests that ship with the project: name -> file, by name."""
    for folder in manifest_folders():
        found = {
            file.stem: file
            for file in sorted(folder.glob("*.toml"))
            if not file.name.endswith((".rig.toml", ".world.toml"))
        }
        if found:
            return found
    return {}


def manifest_folders() -> list[Path]:
    """Where the shipped manifests may be: in a source checkout beside the package, else where an installer puts data."""
    checkout = Path(__file__).resolve().parents[2]
    folders = [checkout / "datasets"] if (checkout / "pyproject.toml").is_file() else []
    user = sysconfig.get_path("data", sysconfig.get_preferred_scheme("user"))
    return [*folders, Path(sysconfig.get_path("data")) / SHIPPED, Path(user) / SHIPPED]

"""Reading and writing ``NAME.rig.toml``."""

from __future__ import annotations

from pathlib import Path

from factorgraph_loc.files.models import parse_model, read_toml, write_toml
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.rfid.grids import write_grid
from factorgraph_loc.sensors.rfid.settings import GridSettings


def read_rig(path: str | Path) -> Rig:
    """Read ``NAME.rig.toml``; InputError names file, key and what is expected. Grids are looked for beside it."""
    path = Path(path)
    return placed(parse_model(Rig, read_toml(path), path), path.parent)


def placed(rig: Rig, folder: Path) -> Rig:
    """The rig, whose grids are files in ``folder``."""
    if rig.rfid is None:
        return rig
    models = {k: m.placed(folder) if isinstance(m, GridSettings) else m for k, m in rig.rfid.models.items()}
    return rig.model_copy(update={"rfid": rig.rfid.model_copy(update={"models": models})})


def write_rig(rig: Rig, path: str | Path) -> None:
    """Write ``NAME.rig.toml``, and its grids beside it."""
    path = Path(path)
    for model in (rig.rfid.models if rig.rfid else {}).values():
        if isinstance(model, GridSettings) and model.path().resolve() != (path.parent / model.file).resolve():
            write_grid(model.model(), path.parent / model.file)
    write_toml(path, rig.model_dump(mode="json", exclude_none=True))

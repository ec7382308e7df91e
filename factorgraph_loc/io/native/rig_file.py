"""Reading and writing ``NAME.rig.toml``."""

from pathlib import Path

from factorgraph_loc.files.models import parse_model, read_toml, write_toml
from factorgraph_loc.model.rig import Rig


def read_rig(path: str | Path) -> Rig:
    """Read ``NAME.rig.toml``; InputError names file, key and expected value. Grids are read from the same folder."""
    path = Path(path)
    return parse_model(Rig, read_toml(path), path).placed(path.parent)


def write_rig(rig: Rig, path: str | Path) -> None:
    """Write ``NAME.rig.toml``, and its grids to the same folder."""
    path = Path(path)
    rig.write_beside(path.parent)
    write_toml(path, rig.model_dump(mode="json", exclude_none=True))

"""The reader of the UTIAS MRCLAM data set: the log of one robot from a folder of ``.dat`` files.

Data set: Leung, Halpern, Barfoot, Liu, IJRR 30(8), 2011.

The tables are described in ``datasets/mrclam.reader.toml``, a manifest of the reader ``mapped``.
"""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from factorgraph_loc.files import bounded, shipped
from factorgraph_loc.files.models import FileModel, parse_model, parse_toml, read_text
from factorgraph_loc.io.readers import mapped
from factorgraph_loc.io.readers.manifests import Manifest
from factorgraph_loc.model.log import Log


class Options(FileModel):
    """The options of the reader ``mrclam``."""

    robot: Annotated[int, Field(ge=1, le=5)]
    """number of the robot in the data set"""


def read(path: Path | None, options: Options) -> Log:
    """Return the log of one robot of the data set MRCLAM from the folder ``path``. ``options``: the number of the
    robot. Raises InputError with file and row of an invalid value."""
    file = shipped.readers()["mrclam"]
    text = read_text(file, bounded.SETTINGS).replace("{robot}", str(options.robot))
    manifest = parse_model(Manifest, parse_toml(text, file), file)
    return mapped.read(path, parse_model(mapped.Options, manifest.options, file))

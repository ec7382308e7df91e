"""Content of the small files in the store, with validation."""

from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from factorgraph_loc.errors import InputError

Whole = Annotated[int, Field(strict=True, ge=-(2**63), lt=2**63)]  # as in tables
Figure = Whole | Annotated[float, Field(strict=True, allow_inf_nan=False)] | None
FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")]  # of a file within the run's folder


class DamagedError(InputError):
    """A stored file is missing, or differs from what was written."""


class StoredFile(BaseModel):
    """Base of the store's JSON files."""

    model_config = ConfigDict(frozen=True, strict=True)


class FileSum(StoredFile):
    """Size and checksum of a file."""

    bytes: Whole
    sha256: str


class RunManifest(StoredFile):
    """The ``key`` of a run and its ``files`` by name."""

    key: str
    files: dict[FileName, FileSum]


class Failure(StoredFile):
    """Why a run gave no results."""

    kind: str
    reason: str


class Figures(StoredFile):
    """Scores or times of a run: numbers, None, and lists of these, besides the ``warnings``."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Figure | list[Figure]] = Field(init=False)
    warnings: list[str] = []


Kind = TypeVar("Kind", bound=StoredFile)


def parse_stored(kind: type[Kind], content: bytes, path: Path) -> Kind:
    """Parse the JSON ``content`` of the file ``path``. Raises DamagedError if it is not of that ``kind``."""
    try:
        return kind.model_validate_json(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])[:60]
        raise DamagedError(f"{path}: is damaged ({where}{': ' * bool(where)}{first['msg'][:80]})") from error

"""What the small files of the store hold; one that holds anything else is damaged."""

from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from factorgraph_loc.errors import InputError

Whole = Annotated[int, Field(strict=True, ge=-(2**63), lt=2**63)]  # as tables hold them
Figure = Whole | Annotated[float, Field(strict=True, allow_inf_nan=False)] | None
FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")]  # of a file within the run's folder


class DamagedError(InputError):
    """A stored file is not there, or not as it was written."""


class StoredFile(BaseModel):
    """Base of what the store keeps as JSON."""

    model_config = ConfigDict(frozen=True, strict=True)


class FileSum(StoredFile):
    """Size and checksum of a file."""

    bytes: Whole
    sha256: str


class Manifest(StoredFile):
    """The ``key`` of a run and its ``files`` by name."""

    key: str
    files: dict[FileName, FileSum]


class Failure(StoredFile):
    """Why a run gave no results."""

    kind: str
    reason: str


class Figures(StoredFile):
    """Scores or times of a run: beside the ``warnings`` numbers, None, and lists of these."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Figure | list[Figure]] = Field(init=False)
    warnings: list[str] = []


Kind = TypeVar("Kind", bound=StoredFile)


def parse_stored(kind: type[Kind], content: bytes, path: Path) -> Kind:
    """The JSON ``content`` of the file ``path``; DamagedError if it is not of that ``kind``."""
    try:
        return kind.model_validate_json(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])[:60]
        raise DamagedError(f"{path}: is damaged ({where}{': ' * bool(where)}{first['msg'][:80]})") from error

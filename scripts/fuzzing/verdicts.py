"""Verdict on a case: read, refused in one short line, or bad."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from factorgraph_loc.errors import FglocError

LONGEST = 300  # letters of a message
PACKAGES = ("factorgraph_loc", "factors", "scripts")


class WrongResultError(AssertionError):
    """A result that is not finite, not positive definite, or changed by a query."""


@dataclass(frozen=True)
class Verdict:
    """``error``: type of the exception, raised at ``place`` with ``message``; empty if the case was read."""

    outcome: Literal["read", "refused", "bad"]
    error: str = ""
    place: str = ""
    message: str = ""

    def plain(self) -> dict[str, Any]:
        return asdict(self)


def fault_of(message: str, longest: int = LONGEST) -> str:
    """Why a message is not one short line; empty if it is."""
    if not message:
        return "empty message"
    if "\n" in message:
        return "message of several lines"
    if not message.isprintable():
        return "message with control characters"
    return "long message" if len(message) > longest else ""


def judge(call: Callable[[], object], *, tell: bool = False) -> Verdict:
    """The verdict on a call; ``tell``: print the traceback of bad cases."""
    try:
        call()
    except FglocError as error:
        if fault := fault_of(str(error)):
            return Verdict("bad", fault, place_of(error), str(error)[:600])
        return Verdict("refused", type(error).__name__, place_of(error), str(error))
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # polars' PanicException and SystemExit are not subclasses of Exception
        if tell:
            traceback.print_exc()
        return Verdict("bad", type(error).__name__, place_of(error), str(error)[:300])
    return Verdict("read")


def place_of(error: BaseException) -> str:
    """The innermost line of the project in the traceback."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        parts = Path(frame.filename).parts
        own = [i for i, part in enumerate(parts) if part in PACKAGES]
        if own and "fuzzing" not in parts:
            return f"{'/'.join(parts[own[-1] :])}:{frame.lineno} {frame.name}"
    return "outside of the project"

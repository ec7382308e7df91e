"""What came of a case: it was read, refused in one short line, or it went wrong."""

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
    """A result that is not what was promised: not finite, not positive, changed by a question."""


@dataclass(frozen=True)
class Verdict:
    """``error``: the type of what was raised, at ``place``, with ``message``; for a case that was read all are empty."""

    outcome: Literal["read", "refused", "bad"]
    error: str = ""
    place: str = ""
    message: str = ""

    def plain(self) -> dict[str, Any]:
        return asdict(self)


def fault_of(message: str, longest: int = LONGEST) -> str:
    """What keeps a message from being one short line; nothing if it is one."""
    if not message:
        return "empty message"
    if "\n" in message:
        return "message of several lines"
    if not message.isprintable():
        return "message with control characters"
    return "long message" if len(message) > longest else ""


def judge(call: Callable[[], object], *, tell: bool = False) -> Verdict:
    """What a call comes to; ``tell``: print the traceback of what went wrong."""
    try:
        call()
    except FglocError as error:
        if fault := fault_of(str(error)):
            return Verdict("bad", fault, place_of(error), str(error)[:600])
        return Verdict("refused", type(error).__name__, place_of(error), str(error))
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # polars' PanicException is no Exception, and SystemExit is none either
        if tell:
            traceback.print_exc()
        return Verdict("bad", type(error).__name__, place_of(error), str(error)[:300])
    return Verdict("read")


def place_of(error: BaseException) -> str:
    """The innermost line of the project from which it was raised."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        parts = Path(frame.filename).parts
        own = [i for i, part in enumerate(parts) if part in PACKAGES]
        if own and "fuzzing" not in parts:
            return f"{'/'.join(parts[own[-1] :])}:{frame.lineno} {frame.name}"
    return "outside of the project"

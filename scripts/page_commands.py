"""What a page of the docs tells its readers to do: the commands in its console blocks, the lines after ``$``; its blocks of Python;
and the files that it tells to write, blocks of TOML whose first line is a comment with the file's name.
"""

import re
from dataclasses import dataclass

_BLOCK = re.compile(r"^```(console|python|toml)\n(.*?)^```", re.DOTALL | re.MULTILINE)
_NAMED = re.compile(r"# ([\w.-]+\.toml)\b")
# data of the reader's own or of others, installations, windows
_ELSEWHERE = re.compile(
    r"\b(LOG|DATA|FOLDER)\b|(?<![\w/])(monday|tuesday|friday|another|hall)/(?!\S)|\b(sevenscenes|starry_night)\b"
    r"|\b(MH_01_easy|dataset)\b|^(pip|rerun) |^fgloc view"
)


@dataclass(frozen=True)
class Step:
    """A ``command``; or else the ``content`` of the ``file`` to write, or without a name of the Python to execute."""

    command: str | None = None
    file: str | None = None
    content: str = ""


def commands(text: str) -> list[str]:
    """All commands of a page, without comments."""
    return [command for kind, block in _BLOCK.findall(text) if kind == "console" for command in _lines(block)]


def runnable(text: str) -> list[str]:
    """Those that need no data, and neither install anything nor open a window."""
    return [command for command in commands(text) if not _ELSEWHERE.search(command)]


def steps(text: str) -> list[Step]:
    """The runnable commands, the files and the Python of a page, in their order."""
    found = []
    for kind, block in _BLOCK.findall(text):
        if kind == "console":
            found += [Step(command) for command in _lines(block) if not _ELSEWHERE.search(command)]
        elif kind == "python":
            found.append(Step(content=block))
        elif named := _NAMED.match(block):
            found.append(Step(file=named[1], content=block))
    return found


def tables(text: str) -> list[str]:
    """The blocks of TOML of a page."""
    return [block for kind, block in _BLOCK.findall(text) if kind == "toml"]


def _lines(block: str) -> list[str]:
    return [re.sub(r" +# .*", "", line.removeprefix("$ ")) for line in block.splitlines() if line.startswith("$ ")]

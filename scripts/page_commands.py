"""The commands on a page of the docs: the lines after ``$`` in its console blocks."""

import re

_BLOCK = re.compile(r"^```console\n(.*?)^```", re.DOTALL | re.MULTILINE)
# data of the reader's own or of others, installations, windows
_ELSEWHERE = re.compile(
    r"\b(LOG|DATA|FOLDER)\b|(?<![\w/])(monday|tuesday|friday|another|hall)/(?!\S)|\b(sevenscenes|starry_night)\b"
    r"|^(pip|rerun) |^fgloc view"
)


def commands(text: str) -> list[str]:
    """All commands of a page, without comments."""
    lines = [line for block in _BLOCK.findall(text) for line in block.splitlines()]
    return [re.sub(r" +# .*", "", line.removeprefix("$ ")) for line in lines if line.startswith("$ ")]


def runnable(text: str) -> list[str]:
    """Those that need no data, and neither install anything nor open a window."""
    return [command for command in commands(text) if not _ELSEWHERE.search(command)]

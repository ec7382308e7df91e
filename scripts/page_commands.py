"""Extraction of the steps that a page of the docs asks its readers to do.

The steps are the commands in console blocks (lines after ``$``), blocks of Python, and files to write. A file to write is a block
of TOML whose first line is a comment with the name of the file.
"""

import re
from dataclasses import dataclass

MORE = "..."
_BLOCK = re.compile(r"^```(console|python|toml)\n(.*?)^```", re.DOTALL | re.MULTILINE)
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_NAMED = re.compile(r"# ([\w.-]+\.toml)\b")
# commands that cannot be run in a test: they need data that is not in the package, install something, or open a window
_ELSEWHERE = re.compile(
    r"\b(LOG|DATA|FOLDER)\b|(?<![\w/])(monday|tuesday|friday|another|hall)/(?!\S)"
    r"|^(pip|rerun) |^fgloc view"
)


@dataclass(frozen=True)
class Step:
    """A step of a page: a command, a file to write, or Python code to execute.

    ``command``: None for files and code. ``shown``: the output of the command on the page. ``file``: the name of a file, None for
    code.
    ``content``: that of the file, or the code.
    """

    command: str | None = None
    shown: str = ""
    file: str | None = None
    content: str = ""


def commands(text: str) -> list[str]:
    """Return all commands of a page, without comments."""
    return [command for kind, block in _BLOCK.findall(text) if kind == "console" for command, _ in _typed(block)]


def runnable(text: str) -> list[str]:
    """Return the commands of a page that can be run in a test: they need no data, install nothing and open no window."""
    return [command for command in commands(text) if not _ELSEWHERE.search(command)]


def steps(text: str, *, shown: bool = False) -> list[Step]:
    """Return the steps of a page in their order, without commands that cannot be run. ``shown``: only files, and commands in
    console blocks that show an output."""
    found = []
    for kind, block in _BLOCK.findall(text):
        if kind == "console":
            typed = [Step(line, output) for line, output in _typed(block)]
            wanted = not shown or any(step.shown for step in typed)
            found += [step for step in typed if wanted and not _ELSEWHERE.search(step.command or "")]
        elif kind == "python":
            found += [] if shown else [Step(content=block)]
        elif named := _NAMED.match(block):
            found.append(Step(file=named[1], content=block))
    return found


def tables(text: str) -> list[str]:
    """Return the blocks of TOML of a page."""
    return [block for kind, block in _BLOCK.findall(text) if kind == "toml"]


def not_as_shown(shown: str, printed: str) -> str | None:
    """Compare the output on a page with the printed output of a command. Returns the first line that differs, or None if both
    agree.

    A line ``...`` on the page matches any number of lines, and a word ``...`` at the end of a line any number of words. Numbers may
    differ by 5 % or by one in their last digit. Durations may differ by any amount.
    """
    left = [line.split() for line in printed.splitlines() if line.strip()]
    skips = False
    for line in (line for line in shown.splitlines() if line.strip()):
        if line.strip() == MORE:
            skips = True
            continue
        at = next((i for i, words in enumerate(left if skips else left[:1]) if _alike(line.split(), words)), None)
        if at is None:
            return line
        left, skips = left[at + 1 :], False
    return None if skips or not left else f"{' '.join(left[0])} (is printed, but not shown)"


def _alike(shown: list[str], printed: list[str]) -> bool:
    if shown[-1] == MORE:
        shown, printed = shown[:-1], printed[: len(shown) - 1]
    timed = set(range(len(shown))) if shown[:1] == ["time:"] else set()
    if re.fullmatch(r"\d+/\d+", shown[-1]):  # a row of fgloc compare: two of its columns are durations
        timed = {len(shown) - 4, len(shown) - 3}
    return len(shown) == len(printed) and all(
        _is_near(a, b, timed=i in timed) for i, (a, b) in enumerate(zip(shown, printed, strict=True))
    )


def _is_near(shown: str, printed: str, *, timed: bool) -> bool:
    """True if two words are equal, apart from numbers, and their numbers are nearly equal. ``timed``: the numbers are durations."""
    if set(shown) | set(printed) == {"─"}:  # the line below the head of a table
        return True
    numbers = list(zip(_NUMBER.findall(shown), _NUMBER.findall(printed), strict=False))
    last = [10.0 ** -len(a.partition(".")[2]) if "." in a else 0.0 for a, _ in numbers]
    near = (
        abs(float(a) - float(b)) <= max(0.05 * abs(float(a)), 1.01 * d) for (a, b), d in zip(numbers, last, strict=True)
    )
    return _NUMBER.sub("0", shown) == _NUMBER.sub("0", printed) and (timed or all(near))


def _typed(block: str) -> list[tuple[str, str]]:
    """Return the commands of a console block without comments, each with the lines below it, which are its output."""
    parts = re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]
    typed = (part.partition("\n") for part in parts)
    return [(re.sub(r" +# .*", "", command), shown) for command, _, shown in typed]

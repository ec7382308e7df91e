"""Warnings as values (:class:`Notice`), and the safe display of names and values from files or other programs.

A displayed text has a bounded length, is on one line, and contains no control characters.
"""

import json
import math
import reprlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, is_dataclass
from string import Formatter
from typing import Any

# maximum sizes of displayed texts
MESSAGE = 300  # characters of a message
NAME = 120  # maximum characters of a name, a path or a message of another library
VALUE = 80  # maximum characters of a value
LISTED = 10  # maximum names of a list
ITEMS = 5  # maximum displayed items of a value that is a list or a table
DEPTH = 3  # maximum displayed nesting levels of a value
LONG_NUMBER = 40  # maximum digits of a displayed integer; larger integers are described
CUT = "..."  # replaces the middle of a text that is too long


@dataclass(frozen=True)
class Notice:
    """A warning or note for the user. ``str(notice)`` is its text.

    ``kind``: identifies the warning for programs, such as ``late_rows``. ``sentence``: the text, with names in braces
    as in :meth:`str.format`. ``fields``: the values that replace these names.
    """

    kind: str
    sentence: str
    fields: Mapping[str, Any]

    def __str__(self) -> str:
        return plain(self.sentence.format(**self.fields), None)

    def __hash__(self) -> int:
        return hash(str(self))

    def about(self, name: str) -> "Notice":
        """Return the notice with ``name``, such as the name of a log or file, in front of its text."""
        return Notice(self.kind, "{about}: " + self.sentence, {"about": name, **self.fields})


def notice(kind: str, sentence: str, *values: object) -> Notice:
    """Return a :class:`Notice`. ``kind``: identifies it for programs. ``sentence``: the text, with names in braces.

    ``values``: replace the names in braces, in order of appearance."""
    names = dict.fromkeys(name for _, name, _, _ in Formatter().parse(sentence) if name)
    numbers = (value.item() if hasattr(value, "item") else value for value in values)
    plainly = (value if isinstance(value, int | float | str) else str(value) for value in numbers)
    return Notice(kind, sentence, dict(zip(names, plainly, strict=True)))


def number(value: float | None, digits: int = 4) -> str:
    """Return a number as text with ``digits`` digits after the decimal point. Return "-" for None, NaN and infinity."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def significant(value: float, *, sign: bool = False) -> str:
    """Return a number as text with three significant digits and without exponent. Return "–" if it is not finite.

    ``sign``: whether a positive number has a plus sign.
    """
    if not math.isfinite(value):
        return "–"
    if value == 0.0:
        return "0"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    text = f"{value:+,.{min(digits, 6)}f}" if sign else f"{value:,.{min(digits, 6)}f}"
    return text.replace(",", "\u202f").replace("-", "\u2212")


def plain(text: object, limit: int | None = NAME) -> str:
    """Return ``text`` on one line. Non-printable characters are escaped.

    The middle of a text of more than ``limit`` characters is replaced by "..."; None is no limit.
    """
    whole = str(text)
    if limit is not None:
        whole = shortened(whole, limit)  # before escaping, to save time with a very long text
    if not whole.isprintable():
        whole = "".join(c if c.isprintable() else _escape(c) for c in whole)
    return whole if limit is None else shortened(whole, limit)


class _Brief(reprlib.Repr):
    """Makes a ``repr`` of limited length. Parts of a large value that are not displayed cost no time."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxstring = DEPTH, VALUE
        self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = self.maxdict = ITEMS

    def repr1(self, value: Any, level: int) -> str:
        if getattr(value, "ndim", None) == 0 and hasattr(value, "item"):
            value = value.item()  # a numpy scalar, whose repr includes its type
        return super().repr1(value, level)

    def repr_int(self, value: int, level: int) -> str:
        digits = int(value.bit_length() * math.log10(2)) + 1
        return repr(value) if digits <= LONG_NUMBER else f"a whole number of about {digits} digits"

    def repr_instance(self, value: object, level: int) -> str:
        try:
            return " ".join(repr(value).split())
        except Exception:  # the repr of a foreign type may raise anything
            return f"<{type(value).__name__}>"


_BRIEF = _Brief()


def quoted(value: object) -> str:
    """Return the ``repr`` of ``value`` in at most :data:`VALUE` characters, for messages. Long values are abbreviated."""
    return plain(_BRIEF.repr(value), VALUE)


def listed(names: Iterable[object], most: int = LISTED) -> str:
    """Return the first ``most`` names, separated by commas, and the number of further names: "a, b and 3 more"."""
    every = list(names)
    shown = ", ".join(plain(name) for name in every[:most])
    return shown if len(every) <= most else f"{shown} and {len(every) - most} more"


def error_text(error: BaseException) -> str:
    """Return the message of an exception of another library on one line, or its class name if it has no message."""
    says = " ".join(str(getattr(error, "strerror", None) or error).split())
    return plain(says or type(error).__name__)


def plain_values(value: Any) -> Any:
    """Return ``value``, converted to types that JSON has.

    Data classes and mappings become dictionaries, arrays and tuples become lists, and NaN and infinity become None.
    """
    if is_dataclass(value):
        return {name: plain_values(getattr(value, name)) for name in value.__dataclass_fields__}
    if hasattr(value, "tolist"):  # an array
        return plain_values(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): plain_values(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_values(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def json_text(content: Any) -> str:
    """Return ``content`` as the text of a JSON file, after conversion by :func:`plain_values`."""
    return json.dumps(plain_values(content), indent=2, allow_nan=False) + "\n"


def well_formed(text: str) -> str:
    """Return ``text`` with lone UTF-16 surrogates escaped, so that it can be encoded in UTF-8.

    Python represents undecodable bytes of file names by such surrogates.
    """
    return text.encode("utf-8", "backslashreplace").decode()


def one_line(message: str) -> str:
    """Return a message on one line, shortened to at most :data:`MESSAGE` characters."""
    return plain(message.strip(), MESSAGE)


def plain_lines(text: str) -> str:
    """Return a text of several lines with non-printable characters escaped, except for line ends."""
    return "\n".join(plain(line, None) for line in text.split("\n"))


def shortened(text: str, limit: int) -> str:
    """Return ``text``. If it has more than ``limit`` characters, its middle is replaced by "..."."""
    if len(text) <= limit:
        return text
    end = (limit - len(CUT)) * 2 // 5
    return f"{text[: limit - len(CUT) - end]}{CUT}{text[len(text) - end :]}"


def _escape(character: str) -> str:
    """Return the escape sequence of a character: for ASCII as in Python, for other characters as in JSON and TOML."""
    code = ord(character)
    return repr(character)[1:-1] if code < 0x80 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"

"""Notices, and the safe display of names and values of foreign origin: bounded length, one line, no control characters."""

import json
import math
import reprlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, is_dataclass
from string import Formatter
from typing import Any

MESSAGE = 300  # characters of a message at most
NAME = 120  # characters of a name, a path or a foreign message
VALUE = 80  # characters of a value
LISTED = 10  # names shown of a list
ITEMS = 5  # items shown of a value that is a list or a table
DEPTH = 3  # nesting levels shown of a value
LONG_NUMBER = 40  # digits above which an integer is described instead of printed
CUT = "..."


@dataclass(frozen=True)
class Notice:
    """A warning or note of a ``kind``, such as ``late_rows``. Printed, it is its ``sentence`` with the ``fields`` in the braces."""

    kind: str
    sentence: str
    fields: Mapping[str, Any]

    def __str__(self) -> str:
        return plain(self.sentence.format(**self.fields), None)

    def __hash__(self) -> int:
        return hash(str(self))

    def about(self, name: str) -> "Notice":
        """The notice with the ``name`` of its log or file in front."""
        return Notice(self.kind, "{about}: " + self.sentence, {"about": name, **self.fields})


def notice(kind: str, sentence: str, *values: object) -> Notice:
    """A notice with the ``values`` of its fields, numbers and texts, in the order of the names in the ``sentence``."""
    names = dict.fromkeys(name for _, name, _, _ in Formatter().parse(sentence) if name)
    numbers = (value.item() if hasattr(value, "item") else value for value in values)
    plainly = (value if isinstance(value, int | float | str) else str(value) for value in numbers)
    return Notice(kind, sentence, dict(zip(names, plainly, strict=True)))


def number(value: float | None, digits: int = 4) -> str:
    """A number with that many decimals; a dash if there is none, or it is not finite."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def significant(value: float, *, sign: bool = False) -> str:
    """A number with three significant digits, without exponent, and with a plus if ``sign``; a dash if it is not finite."""
    if not math.isfinite(value):
        return "–"
    if value == 0.0:
        return "0"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    text = f"{value:+,.{min(digits, 6)}f}" if sign else f"{value:,.{min(digits, 6)}f}"
    return text.replace(",", "\u202f").replace("-", "\u2212")


def plain(text: object, limit: int | None = NAME) -> str:
    """``text`` on one line: non-printable characters are escaped, and the middle of a text above ``limit`` characters is cut."""
    whole = str(text)
    if limit is not None:
        whole = shortened(whole, limit)  # first, so that little of a very long text is processed
    if not whole.isprintable():
        whole = "".join(c if c.isprintable() else _escape(c) for c in whole)
    return whole if limit is None else shortened(whole, limit)


class _Brief(reprlib.Repr):
    """A ``repr`` that computes no more than is shown."""

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
    """The ``repr`` of ``value`` in at most :data:`VALUE` characters. Long texts, long lists and huge integers are abbreviated."""
    return plain(_BRIEF.repr(value), VALUE)


def listed(names: Iterable[object], most: int = LISTED) -> str:
    """``a, b, c``: the first ``most`` names, and the number of the others."""
    every = list(names)
    shown = ", ".join(plain(name) for name in every[:most])
    return shown if len(every) <= most else f"{shown} and {len(every) - most} more"


def error_text(error: BaseException) -> str:
    """The message of a foreign exception on one line, or its class name if it has none."""
    says = " ".join(str(getattr(error, "strerror", None) or error).split())
    return plain(says or type(error).__name__)


def plain_values(value: Any) -> Any:
    """A value as in JSON: dictionaries for data classes and mappings, lists for arrays and tuples, null for NaN and infinity."""
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
    """The text of a JSON file; see :func:`plain_values`."""
    return json.dumps(plain_values(content), indent=2, allow_nan=False) + "\n"


def well_formed(text: str) -> str:
    """``text`` with lone surrogates (undecodable bytes of file names) escaped, so that it can be encoded as UTF-8."""
    return text.encode("utf-8", "backslashreplace").decode()


def one_line(message: str) -> str:
    """A message on one line, with at most :data:`MESSAGE` characters."""
    return plain(message.strip(), MESSAGE)


def plain_lines(text: str) -> str:
    """A text of several lines with non-printable characters escaped, except for line ends, for files that people print."""
    return "\n".join(plain(line, None) for line in text.split("\n"))


def shortened(text: str, limit: int) -> str:
    """``text``, with the middle cut out if it has more than ``limit`` characters."""
    if len(text) <= limit:
        return text
    end = (limit - len(CUT)) * 2 // 5
    return f"{text[: limit - len(CUT) - end]}{CUT}{text[len(text) - end :]}"


def _escape(character: str) -> str:
    """Escape a character as in Python; beyond ASCII as in JSON and TOML."""
    code = ord(character)
    return repr(character)[1:-1] if code < 0x80 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"

"""How names and values that others wrote are shown to people: bounded in length, on one line, and without a character that a
terminal would obey in place of showing it."""

import math
from collections.abc import Iterable, Mapping, Sequence, Set
from itertools import islice

MESSAGE = 300  # characters of a message at most
NAME = 120  # of a name, a path or a foreign message within it
VALUE = 80  # of a value within it
LISTED = 10  # names of a list that are shown
ITEMS = 5  # of a value that is a list or a table
DEPTH = 3  # of values within values
LONG_NUMBER = 40  # digits beyond which a whole number is only described
CUT = "..."


def plain(text: object, limit: int | None = NAME) -> str:
    """``text`` as it may stand on a line: what is no printable character (control characters, ends of lines, marks that turn
    the direction of writing, lone surrogates) as an escape, and of more than ``limit`` characters the middle left out."""
    whole = str(text)
    if limit is not None:
        whole = shortened(whole, limit)  # before it is escaped: of megabytes little is looked at
    if not whole.isprintable():
        whole = "".join(c if c.isprintable() else _escape(c) for c in whole)
    return whole if limit is None else shortened(whole, limit)


def quoted(value: object, limit: int = VALUE) -> str:
    """``value`` as Python writes it, text in quotes, in at most ``limit`` characters: of long text the middle is left out, of
    long lists the end, and a whole number of very many digits is described."""
    return plain(_written(value, limit, DEPTH), limit)


def listed(names: Iterable[object], most: int = LISTED) -> str:
    """``a, b, c``: of more than ``most`` names the first, and how many more there are."""
    every = list(names)
    shown = ", ".join(plain(name) for name in every[:most])
    return shown if len(every) <= most else f"{shown} and {len(every) - most} more"


def told(error: BaseException) -> str:
    """What an exception of other code says, on one line; the kind of exception where it says nothing."""
    says = " ".join(str(getattr(error, "strerror", None) or error).split())
    return plain(says or type(error).__name__)


def well_formed(text: str) -> str:
    """``text`` as every file and table can hold it: lone surrogates, the bytes of file names that are not UTF-8, as escapes."""
    return text.encode("utf-8", "backslashreplace").decode()


def one_line(message: str) -> str:
    """A message as errors carry it."""
    return plain(message.strip(), MESSAGE)


def shortened(text: str, limit: int) -> str:
    """``text`` if it has at most ``limit`` characters, else its beginning and its end."""
    if len(text) <= limit:
        return text
    end = (limit - len(CUT)) * 2 // 5
    return f"{text[: limit - len(CUT) - end]}{CUT}{text[len(text) - end :]}"


def _escape(character: str) -> str:
    """As in Python, but beyond ASCII always in the way that JSON and TOML know too."""
    code = ord(character)
    return repr(character)[1:-1] if code < 0x80 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def _written(value: object, limit: int, depth: int) -> str:
    """As ``repr``, of which no more is computed than is shown."""
    if getattr(value, "ndim", None) == 0 and hasattr(value, "item"):
        value = value.item()  # a scalar of numpy, whose own repr names its type
    if isinstance(value, (str, bytes)):
        return repr(shortened(value, limit) if isinstance(value, str) else value[:limit])
    if isinstance(value, int) and (digits := int(value.bit_length() * math.log10(2)) + 1) > LONG_NUMBER:
        return f"a whole number of about {digits} digits"
    if isinstance(value, (Mapping, list, tuple, Set)):
        return _collection(value, limit, depth)
    try:
        return " ".join(repr(value).split())
    except Exception:  # whatever another's type raises: its name can be shown
        return f"<{type(value).__name__}>"


def _collection(values: Mapping[object, object] | Sequence[object] | Set[object], limit: int, depth: int) -> str:
    begin, end = ("[", "]") if isinstance(values, list) else ("(", ")") if isinstance(values, tuple) else ("{", "}")
    if depth == 0 and values:
        return f"{begin}{CUT}{end}"
    items = [_written(item, limit, depth - 1) for item in islice(values, ITEMS)]
    if isinstance(values, Mapping):
        contents = islice(values.values(), ITEMS)
        items = [f"{key}: {_written(item, limit, depth - 1)}" for key, item in zip(items, contents, strict=True)]
    if len(values) > ITEMS:
        items.append(CUT)
    return f"{begin}{', '.join(items)}{end}"

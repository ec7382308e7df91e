"""HTML pages from the Jinja2 templates in ``templates``. All values are escaped.

A page loads nothing: style, script, data and pictures are included, and its content security policy forbids everything else, so
that an unescaped string could not run. The same values give the same bytes.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

from factorgraph_loc.text import Notice, plain
from factorgraph_loc.version import __version__

if TYPE_CHECKING:
    from jinja2 import Environment


class Cell(NamedTuple):
    """A cell of a table: a ``value``, smaller ``lines`` below it, its CSS class ``kind``, and the number of its ``colour``."""

    value: str
    lines: Sequence[str] = ()
    kind: str = ""
    colour: int | None = None


class Picture(NamedTuple):
    """An image, as a data URI."""

    uri: str

    @classmethod
    def of(cls, kind: str, content: bytes) -> Picture:
        """The image in a file of the given media type."""
        return cls(f"data:{kind};base64,{base64.b64encode(content).decode()}")


Rows = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""Header and rows of a table of texts. The first cell of each row is its header."""
Table = tuple[Sequence[str | Cell], Sequence[Sequence[str | int | Cell]]]
"""Header and rows of any table."""
Part = str | Rows | Picture
"""A paragraph, a table, or a picture."""


def render(template: str, **values: Any) -> str:
    """Return the page of a template in ``templates`` with these values."""
    return _environment().get_template(template).render(version=__version__, **values)


def sectioned(title: str, lead: str, doubts: Sequence[Notice], sections: Mapping[str, Sequence[Part]]) -> str:
    """Return a page with a ``lead`` paragraph, highlighted ``doubts``, and ``sections`` by their title."""
    names = {f"section-{i}": name for i, name in enumerate(sections)}
    parts = dict(zip(names, sections.values(), strict=True))
    return render("sectioned.html", title=title, lead=lead, doubts=doubts, sections=names, parts=parts)


# control characters but line breaks and tabs, and those that turn the direction of text
CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined  # noqa: PLC0415

    made = Environment(
        loader=PackageLoader("factorgraph_loc.drawing"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_without_controls,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    made.filters["sha256"] = _digest
    return made


def _without_controls(value: Any) -> Any:
    """A text whose control characters, which a terminal would obey, are escaped; any other value itself."""
    if not isinstance(value, str) or not CONTROL.search(value):
        return value
    return type(value)(CONTROL.sub(lambda found: plain(found[0]), value))


def _digest(content: str) -> str:
    """The hash of a style or script, as in a content security policy."""
    return base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()

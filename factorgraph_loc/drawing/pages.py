"""HTML pages from the Jinja2 templates in ``templates``. All values are escaped.

A page loads nothing: style, script, data and pictures are embedded. Its content security policy forbids other scripts,
so a value that is not escaped by mistake cannot run. The same values give the same bytes.
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
    """A cell of an HTML table. ``value``: main text. ``lines``: smaller lines below it. ``kind``: CSS class, "" for
    none.

    ``colour``: index of the colour of a mark in the cell, None for no mark.
    """

    value: str
    lines: Sequence[str] = ()
    kind: str = ""
    colour: int | None = None


class Picture(NamedTuple):
    """An image that is embedded in a page as a data URI."""

    uri: str

    @classmethod
    def of(cls, kind: str, content: bytes) -> Picture:
        """Return the image with the bytes ``content``. ``kind``: media type, such as "image/png"."""
        return cls(f"data:{kind};base64,{base64.b64encode(content).decode()}")


Rows = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""Header and rows of a table of texts. The first cell of each row is a label of the row."""
Table = tuple[Sequence[str | Cell], Sequence[Sequence[str | int | Cell]]]
"""Header and rows of any table."""
Part = str | Rows | Picture
"""A paragraph, a table, or a picture."""


def render(template: str, **values: Any) -> str:
    """Return an HTML page. ``template``: a file name in ``drawing/templates``. ``values``: its variables by name."""
    return _environment().get_template(template).render(version=__version__, **values)


def sectioned(title: str, lead: str, doubts: Sequence[Notice], sections: Mapping[str, Sequence[Part]]) -> str:
    """Return an HTML page with a heading for each section. ``lead``: the introduction. ``doubts``: marked warnings.

    ``sections``: {heading: parts}. A part is a paragraph, a table or a picture.
    """
    names = {f"section-{i}": name for i, name in enumerate(sections)}
    parts = dict(zip(names, sections.values(), strict=True))
    return render("sectioned.html", title=title, lead=lead, doubts=doubts, sections=names, parts=parts)


# control characters except line breaks and tabs, and characters that change the direction of text
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
    """Return a text with its control characters escaped. Return other values unchanged."""
    if not isinstance(value, str) or not CONTROL.search(value):
        return value
    return type(value)(CONTROL.sub(lambda match: plain(match[0]), value))


def _digest(content: str) -> str:
    """Return the hash of a style or script in the form that a content security policy requires."""
    return base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()

"""HTML elements for reports. All values from outside are escaped here."""

import base64
import html
import json
import math
from collections.abc import Iterable
from typing import Any

Rows = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""Header and rows of a table."""


class Html(str):
    """A string that is HTML already and needs no escaping."""

    __slots__ = ()


def text(value: object) -> Html:
    """Return a value as escaped text."""
    return value if isinstance(value, Html) else Html(html.escape(str(value)))


def tag(name: str, *content: object, **attributes: object) -> Html:
    """Return an element. ``class_`` stands for the attribute class, ``data_x`` for data-x; attributes that are None are
    omitted.
    """
    given = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{html.escape(str(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    return Html(f"<{name}{given}>{join(content)}</{name}>")


def join(parts: Iterable[object], between: str = "") -> Html:
    """Join parts, with ``between`` as the separator."""
    return Html(between.join(text(part) for part in parts))


def data(identity: str, content: Any) -> Html:
    """Return a script element with JSON data, escaped such that no string in it can end the element."""
    packed = json.dumps(content, separators=(",", ":"), allow_nan=False)
    safe = packed.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
    return Html(f'<script type="application/json" id="{html.escape(identity)}">{safe}</script>\n')


def table(header: Iterable[object], rows: Iterable[Iterable[object]], *, class_: str | None = None) -> Html:
    """Return a table that scrolls sideways where it is too wide. The first column holds row headers; a cell may be a ``td``
    element.
    """
    head = tag("tr", *(tag("th", cell, scope="col") for cell in header))
    lines = []
    for first, *cells in rows:
        kept = (cell if isinstance(cell, Html) and cell.startswith("<td") else tag("td", cell) for cell in cells)
        lines.append(tag("tr", tag("th", first, scope="row"), *kept))
    return tag("div", tag("table", tag("thead", head), tag("tbody", *lines), class_=class_), class_="wide")


def figure(title: object, caption: object, **attributes: object) -> Html:
    """Return a placeholder for a chart drawn by the page's script, with title and caption."""
    chart = tag("div", class_="chart", **attributes)
    return tag("figure", tag("h3", title), chart, tag("figcaption", caption) if caption else "")


def image(png: bytes) -> Html:
    """Return a PNG image embedded in the page."""
    return Html(f'<img alt="plot" src="data:image/png;base64,{base64.b64encode(png).decode()}">')


def number(value: float | None, digits: int = 4) -> str:
    """Format a number for a table; None gives a dash."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"

"""The few pieces of HTML that pages are made of. Whatever comes from outside is escaped here and nowhere else."""

import base64
import html
import json
import math
from collections.abc import Iterable
from typing import Any

Rows = tuple[tuple[str, ...], list[tuple[str, ...]]]
"""Header and rows of a table."""


class Html(str):
    """Text that is HTML already."""

    __slots__ = ()


def text(value: object) -> Html:
    """A value as it is to be read, whatever it holds."""
    return value if isinstance(value, Html) else Html(html.escape(str(value)))


def tag(name: str, *content: object, **attributes: object) -> Html:
    """An element; ``class_`` stands for the attribute class, ``data_x`` for data-x; attributes that are None are left out."""
    given = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{html.escape(str(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    return Html(f"<{name}{given}>{join(content)}</{name}>")


def join(parts: Iterable[object], between: str = "") -> Html:
    """Parts one after the other."""
    return Html(between.join(text(part) for part in parts))


def data(identity: str, content: Any) -> Html:
    """Data for the script of the page; no string in it can end the element, or begin another."""
    packed = json.dumps(content, separators=(",", ":"), allow_nan=False)
    safe = packed.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
    return Html(f'<script type="application/json" id="{html.escape(identity)}">{safe}</script>\n')


def table(header: Iterable[object], rows: Iterable[Iterable[object]], *, class_: str | None = None) -> Html:
    """A table that scrolls sideways where it is too wide; the first column names the row. Cells may be elements td already."""
    head = tag("tr", *(tag("th", cell, scope="col") for cell in header))
    lines = []
    for first, *cells in rows:
        kept = (cell if isinstance(cell, Html) and cell.startswith("<td") else tag("td", cell) for cell in cells)
        lines.append(tag("tr", tag("th", first, scope="row"), *kept))
    return tag("div", tag("table", tag("thead", head), tag("tbody", *lines), class_=class_), class_="wide")


def figure(title: object, caption: object, **attributes: object) -> Html:
    """A place for a chart that the script draws, with title and caption."""
    chart = tag("div", class_="chart", **attributes)
    return tag("figure", tag("h3", title), chart, tag("figcaption", caption) if caption else "")


def image(png: bytes) -> Html:
    """A PNG image that is part of the page."""
    return Html(f'<img alt="plot" src="data:image/png;base64,{base64.b64encode(png).decode()}">')


def number(value: float | None, digits: int = 4) -> str:
    """A number for a table, a dash where there is none."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"

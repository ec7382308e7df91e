"""What all pages have: head, style, script, and a content security policy that forbids everything else."""

import base64
import hashlib
from collections.abc import Iterable, Sequence
from importlib import resources
from string import Template

from factorgraph_loc.drawing.markup import Html, join, tag, text
from factorgraph_loc.version import __version__

SCRIPTS = ("charts.js", "tracks.js", "page.js")  # of charts that can be used


def whole_page(
    title: str, sections: Sequence[tuple[str, str]], body: Iterable[object], data: str = "", scripts: Sequence[str] = ()
) -> str:
    """An HTML page that loads nothing, of ``body``, whose ``sections`` (id and name) are linked at its head, and of ``data`` and
    ``scripts``, by their names among the assets."""
    style = _asset("page.css")
    script = "".join(_asset(name) for name in scripts)
    return Template(_asset("page.html")).substitute(
        title=text(title),
        contents=join(tag("a", name, href=f"#{identity}") for identity, name in sections),
        body=join(body, "\n"),
        data=data,
        style=style,
        style_hash=_digest(style),
        script=script,
        script_hash=_digest(script),
        version=__version__,
    )


def remark(content: str) -> Html:
    """An explanatory paragraph; a number and its percent sign are not separated."""
    return tag("p", content.replace(" %", "\u00a0%"), class_="note")


def _asset(name: str) -> str:
    return resources.files("factorgraph_loc.evaluation.report").joinpath("assets", name).read_text(encoding="utf-8")


def _digest(content: str) -> str:
    return base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()

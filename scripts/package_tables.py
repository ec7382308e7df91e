"""The packages of the project in layers, and what each imports: the table of docs/architecture.md."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
# from the ground up; packages of one layer may import one another, but not in a circle
LAYERS = (
    ("factors", "errors", "text", "version", "threads", "processes", "drawing", "plugins"),
    ("files",),
    ("maps",),
    ("model", "vision"),
    ("fitting",),
    ("sensors",),
    ("io", "evaluation", "calibration", "fusion"),
    ("exports", "simulation", "mapping", "slam"),
    ("planning",),
    ("experiments", "live"),
    ("api", "cli", "old_places", "builtin", ""),
)
HEIGHT = {package: height for height, packages in enumerate(LAYERS) for package in packages}
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for folder in ("factorgraph_loc", "factors")
    for path in sorted((ROOT / folder).rglob("*.py"))
}


def package_of(module: str) -> str:
    """The package of a module below ``factorgraph_loc``, or ``factors``; that of ``factorgraph_loc`` itself has no name."""
    top, _, below = module.partition(".")
    return top if top == "factors" else below.partition(".")[0]


def imported(module: str, *, at_once: bool = False) -> set[str]:
    """The modules of this project that a module imports, or names in a string; ``at_once``: when it is itself imported."""
    tree = ast.parse(MODULES[module].read_text())
    found: set[str] = set()
    for node in tree.body if at_once else ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {m if (m := f"{node.module}.{alias.name}") in MODULES else node.module for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and not at_once:
            found.add(node.value.partition(":")[0])
    if at_once:  # and the packages that they are in
        found |= {".".join(parts[:i]) for m in found for parts in (m.split("."),) for i in range(2, len(parts))}
        found = {m for m in found if not module.startswith(f"{m}.")}
    return {m for m in found if m in MODULES and m != module}


def tables() -> Iterator[str]:
    """The lines of the table, the top layer first."""
    yield "| package | what it is | imports |"
    yield "|---|---|---|"
    for packages in reversed(LAYERS):
        for package in packages:
            if package:
                yield f"| `{package}` | {_what(package)} | {', '.join(f'`{name}`' for name in _below(package))} |"


def _below(package: str) -> list[str]:
    """The packages that one imports, the highest first; what stands on the ground is left out, as all may use it."""
    found = {package_of(m) for module in MODULES if package_of(module) == package for m in imported(module)}
    return sorted((p for p in found - {package, ""} if HEIGHT[p]), key=lambda p: (-HEIGHT[p], p))


def _what(package: str) -> str:
    name = package if package == "factors" else f"factorgraph_loc.{package}"
    text = ast.get_docstring(ast.parse(MODULES[name].read_text())) or ""
    return " ".join(text.partition("\n\n")[0].split()).replace("``", "`").replace(":mod:", "").replace("|", r"\|")

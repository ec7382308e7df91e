"""The packages of the project in layers, what each imports and what it shows: tree and table of docs/architecture.md."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from functools import cache
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
    ("api", "cli", "builtin", ""),
)
OTHERS = {
    "scripts": "Tests, tables of the docs, conversion of recordings, examples; in benchmarks/ a package for each page of results.",
    "datasets": "Manifests and rigs of known recordings.",
    "docs": "These pages.",
    "tests": "Tests by package; golden/ has the stored results of all estimators.",
}
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


def named(module: str, *, at_once: bool = False) -> frozenset[tuple[str, str]]:
    """What a module of this project imports, or names in a string, as (module, name in it), the name "" where it is the module
    itself; ``at_once``: when it is itself imported."""
    return names_in(MODULES[module], at_once=at_once)


@cache
def names_in(path: Path, *, at_once: bool = False) -> frozenset[tuple[str, str]]:
    """Those of a file, see :func:`named`; of a page, those of the Python files that it shows."""
    shown = re.findall(r"```python\n# \S+\.py\n(.*?)```", path.read_text(), re.DOTALL)
    tree = ast.parse("\n".join(shown) if path.suffix == ".md" else path.read_text())
    found: set[tuple[str, str]] = set()
    for node in tree.body if at_once else ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {(node.module, alias.name) for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {(alias.name, "") for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and not at_once:
            place, _, name = node.value.partition(":")
            found.add((place, name))
    return frozenset((place, name) for place, name in found if place in MODULES)


def imported(module: str, *, at_once: bool = False) -> set[str]:
    """The modules of this project that a module imports, or names in a string; ``at_once``: when it is itself imported."""
    found = {m if (m := f"{place}.{name}") in MODULES else place for place, name in named(module, at_once=at_once)}
    if at_once:  # and the packages that they are in
        found |= {".".join(parts[:i]) for m in found for parts in (m.split("."),) for i in range(2, len(parts))}
        found = {m for m in found if not module.startswith(f"{m}.")}
    return {m for m in found if m in MODULES and m != module}


def steps(place: str, name: str, user: str = "") -> Iterator[tuple[str, str]]:
    """The (package, module or name in it) that whoever imports ``name`` from ``place`` passes, from the outside in, leaving out
    the packages that ``user``, the module that imports it, is in itself."""
    parts = [*place.split("."), *([name] if name else [])]
    for i in range(1, len(parts)):
        package = ".".join(parts[:i])
        if package in FACES and not f"{user}.".startswith(f"{package}."):
            yield package, parts[i]


def _face(path: Path) -> tuple[str, ...]:
    """What a package lists as ``__all__``: what other packages may import of it."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == "__all__":
            return tuple(ast.literal_eval(node.value))
    return ()


# of each package below factorgraph_loc, whose own names are for scripts
FACES = {m: _face(path) for m, path in MODULES.items() if path.name == "__init__.py" and m != "factorgraph_loc"}


def tree() -> Iterator[str]:
    """The lines of the tree of folders, the top layer first."""
    yield from ("```text", "factorgraph_loc/")
    for packages in reversed(LAYERS):
        for package in packages:
            if package not in ("", "factors"):
                folder = MODULES[f"factorgraph_loc.{package}"].name == "__init__.py"
                yield f"    {package + ('/' if folder else '.py'):16}{_what(package)}"
    yield f"{'factors/':20}{_what('factors')}"
    yield from (f"{folder + '/':20}{what}" for folder, what in OTHERS.items())
    yield "```"


def tables() -> Iterator[str]:
    """The lines of the table of imports and public names."""
    yield "| package | imports | modules | private modules | public |"
    yield "|---|---|---|---|---|"
    for package, face in sorted(FACES.items()):
        inside = {m.rpartition(".")[2] for m in MODULES if m.rpartition(".")[0] == package}
        name = package.removeprefix("factorgraph_loc.")
        below = _listed(_below(name)) if name in HEIGHT else ""
        yield f"| `{name}` | {below} | {len(inside)} | {len(inside - set(face))} | {_listed(face)} |"


SECTIONS = {"Packages": tree, "Imports and public names": tables}


def _listed(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _below(package: str) -> list[str]:
    """The packages that one imports, the highest first; what stands on the ground is left out, as all may use it."""
    found = {package_of(m) for module in MODULES if package_of(module) == package for m in imported(module)}
    return sorted((p for p in found - {package, ""} if HEIGHT[p]), key=lambda p: (-HEIGHT[p], p))


def _what(package: str) -> str:
    """The first sentence about a package."""
    name = package if package == "factors" else f"factorgraph_loc.{package}"
    text = " ".join((ast.get_docstring(ast.parse(MODULES[name].read_text())) or "").split())
    return text.partition(". ")[0].rstrip(".").replace("``", "").replace(":mod:", "").replace("`", "") + "."

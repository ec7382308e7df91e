"""The packages of the project in layers, their imports and their public names: the tree and the table of docs/architecture.md."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
# the lowest layer comes first; packages of one layer may import each other, but not in a circle
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
    """Return the name of the package of a module: the part below ``factorgraph_loc``, or ``factors``. It is empty for the package
    ``factorgraph_loc`` itself."""
    top, _, below = module.partition(".")
    return top if top == "factors" else below.partition(".")[0]


def named(module: str, *, at_once: bool = False) -> frozenset[tuple[str, str]]:
    """Return what a module imports from this project, and what its strings name, as pairs (module, name in it). The name is empty
    for a module itself. ``at_once``: only imports that are executed when the module is imported."""
    return names_in(MODULES[module], at_once=at_once)


@cache
def names_in(path: Path, *, at_once: bool = False) -> frozenset[tuple[str, str]]:
    """Return the names that a Python file imports, as :func:`named` does. For a page of the docs, those of the Python files that it
    shows."""
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
    """Return the modules of this project that a module imports or that its strings name. ``at_once``: only imports that are
    executed when the module is imported."""
    found = {m if (m := f"{place}.{name}") in MODULES else place for place, name in named(module, at_once=at_once)}
    if at_once:  # an import also imports the packages that contain the module
        found |= {".".join(parts[:i]) for m in found for parts in (m.split("."),) for i in range(2, len(parts))}
        found = {m for m in found if not module.startswith(f"{m}.")}
    return {m for m in found if m in MODULES and m != module}


def steps(place: str, name: str, user: str = "") -> Iterator[tuple[str, str]]:
    """Yield pairs (package, module or name in it) for an import of ``name`` from the module ``place``, the outermost package first.

    Each second part must be public in its package. Packages that contain ``user``, the importing module, are left out.
    """
    parts = [*place.split("."), *([name] if name else [])]
    for i in range(1, len(parts)):
        package = ".".join(parts[:i])
        if package in FACES and not f"{user}.".startswith(f"{package}."):
            yield package, parts[i]


def _face(path: Path) -> tuple[str, ...]:
    """Return the names in ``__all__`` of a package: the names that other packages may import."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == "__all__":
            return tuple(ast.literal_eval(node.value))
    return ()


# public names of each package; the names of factorgraph_loc itself are for scripts, and are left out
FACES = {m: _face(path) for m, path in MODULES.items() if path.name == "__init__.py" and m != "factorgraph_loc"}


def tree() -> Iterator[str]:
    """Yield the lines of the tree of folders, the top layer first."""
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
    """Yield the lines of the table of imports and public names."""
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
    """Return the packages that a package imports, the highest layer first. The lowest layer is left out."""
    found = {package_of(m) for module in MODULES if package_of(module) == package for m in imported(module)}
    return sorted((p for p in found - {package, ""} if HEIGHT[p]), key=lambda p: (-HEIGHT[p], p))


def _what(package: str) -> str:
    """Return the first sentence of the docstring of a package."""
    name = package if package == "factors" else f"factorgraph_loc.{package}"
    text = " ".join((ast.get_docstring(ast.parse(MODULES[name].read_text())) or "").split())
    return text.partition(". ")[0].rstrip(".").replace("``", "").replace(":mod:", "").replace("`", "") + "."

"""Which code outside the packages of sensors and of files still asks a measurement or a stream for its type or name.

Counted are, whatever the form: ``isinstance`` and ``issubclass``, class patterns of ``match``, comparisons and look-ups of
``type()``, ``singledispatch``, dictionaries by such types, ``hasattr`` of what measurements hold, and names of channels or sensors
that are compared, looked up, matched or keys of a dictionary. ``KEPT`` are those that stay, each with its reason.
"""

import ast
from collections import Counter
from dataclasses import fields
from functools import cache

from package_tables import ROOT

from factorgraph_loc.sensors.registry import channels, sensors

PACKAGE = ROOT / "factorgraph_loc"
APART = ("sensors", "io", "builtin.py")  # the last lists what there is
STREAMS = [stream for channel in channels().values() for stream in channel.streams]
CLASSES = [*STREAMS, *(stream.kind for stream in STREAMS)]
TYPES = {kind.__name__ for kind in CLASSES}
HELD = {field.name for kind in CLASSES for field in fields(kind)} - {"t", "source"}
SECTIONS = {name for sensor in sensors().values() for name in sensor.settings}
# landmarks are what estimators may learn, too, a survey is none of a sensor alone, and tables of results have a position
NAMES = {*channels(), *sensors(), *SECTIONS} - {"landmarks", "survey", "position"}

KEPT = {
    "experiments/maps.py": (1, "the word says whether poses are given or estimated, not which sensor there is"),
    "model/measurement.py": (1, "streams are joined that are of one type, whichever that is"),
    "simulation/filming.py": (1, "who renders images makes the stream of them"),
    "simulation/settings.py": (4, "presets are rigs, as files would say them"),
    "slam/monoslam_sighting.py": (
        3,
        "monoSLAM is made of one sensor, and asks which of the camera's channels are used",
    ),
}


def choices(code: str) -> list[str]:
    """The lines of code that choose by the type or name of a measurement or stream, one entry a choice."""
    lines = code.splitlines()
    found = [node.lineno for node in ast.walk(ast.parse(code)) if _chooses(node)]
    return [lines[number - 1].strip() for number in sorted(found)]


def _chooses(node: ast.AST) -> bool:  # noqa: PLR0911 - a case for each form
    match node:
        case ast.Call(func=ast.Name(id="isinstance" | "issubclass"), args=[_, kind]):
            return _has_type(kind)
        case ast.Call(func=ast.Name(id="hasattr"), args=[_, ast.Constant(value=held)]):
            return held in HELD
        case ast.Call(func=ast.Attribute(attr="get" | "pop"), args=[key, *_]):
            return _is_name(key) or _is_type_call(key)
        case ast.Call(func=ast.Attribute(attr="startswith"), args=[key]):
            return _is_name(key)
        case ast.MatchClass(cls=kind):
            return _has_type(kind)
        case ast.MatchValue(value=value):
            return _is_name(value)
        case ast.Compare(left=left, comparators=others):
            sides = (left, *others)
            of_types = sum(map(_is_type_call, sides))
            return any(map(_is_name, sides)) or of_types > 1 or (of_types == 1 and any(map(_has_type, sides)))
        case ast.Subscript(value=value, slice=key, ctx=ast.Load()):
            return (_is_name(key) and ast.unparse(value) != "Literal") or _is_type_call(key)
        case ast.Dict(keys=keys):
            return any(_is_name(key) or (isinstance(key, ast.Name) and key.id in TYPES) for key in keys)
        case ast.FunctionDef(decorator_list=decorators):
            return any("singledispatch" in ast.unparse(one) for one in decorators)
    return False


def _is_name(node: ast.AST | None) -> bool:
    if isinstance(node, ast.Tuple | ast.Set | ast.List):
        return any(map(_is_name, node.elts))
    return isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in NAMES


def _is_type_call(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "type"


def _has_type(node: ast.AST) -> bool:
    return any(isinstance(one, ast.Name) and one.id in TYPES for one in ast.walk(node))


@cache
def counted() -> Counter[str]:
    """How many choices there are, by file."""
    files = [file for file in sorted(PACKAGE.rglob("*.py")) if file.relative_to(PACKAGE).parts[0] not in APART]
    return Counter({str(file.relative_to(PACKAGE)): len(choices(file.read_text())) for file in files})


def test_nothing_else_chooses_by_type_or_name() -> None:
    most = {file: number for file, (number, _) in KEPT.items()}
    grown = {file: number for file, number in counted().items() if number > most.get(file, 0)}
    shown = {file: choices((PACKAGE / file).read_text()) for file in grown}
    assert not grown, shown


def test_what_is_kept_is_there() -> None:
    found = counted()
    assert {file: found[file] for file in KEPT} == {file: number for file, (number, _) in KEPT.items()}
    assert sum(number for number, _ in KEPT.values()) <= 10

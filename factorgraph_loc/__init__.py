"""Indoor robot localization from wheel odometry, RFID tags, landmarks and cameras.

The public names are imported from this package. They are the commands as functions, such as ``factorgraph_loc.run(log, "ekf")``,
the types of their arguments and results, functions that read and write files, and the online ``Localizer``. The file
``__init__.pyi`` lists the public names and their modules. A module is imported when one of its names is first used.
"""

import ast
import importlib
from pathlib import Path
from typing import Any

from factorgraph_loc import builtin as builtin
from factorgraph_loc.version import __version__ as __version__

_MODULES = {
    name.name: str(line.module)
    for line in ast.parse(Path(__file__).with_suffix(".pyi").read_text("utf-8")).body
    if isinstance(line, ast.ImportFrom)
    for name in line.names
}
__all__ = sorted(_MODULES.keys() - {"__version__"})  # noqa: PLE0605 - a list


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])

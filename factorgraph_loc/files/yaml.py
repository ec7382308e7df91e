"""Reading of YAML files that other programs wrote, such as the descriptions of occupancy maps in ROS."""

from pathlib import Path
from typing import Any

import yaml

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.bounded import YAML, foreign
from factorgraph_loc.files.models import read_text


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, except that aliases are errors, because they can expand to gigabytes."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            event: Any = self.peek_event()  # type: ignore[no-untyped-call]
            problem = f"*{event.anchor} is an alias, expected the value itself"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)
        return super().compose_node(parent, index)


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the content of a YAML file that consists of keys and values. Keys without a value are omitted.

    Raises InputError with file and row if the content is invalid.
    """
    what = "is not YAML that can be read"
    with foreign(path, what):
        try:
            text = read_text(path, YAML)
            if text.startswith("%YAML:"):  # OpenCV writes the directive so
                text = f"#{text}"
            content = yaml.load(text, _Loader) or {}
        except yaml.MarkedYAMLError as error:
            mark = error.context_mark or error.problem_mark
            problem = ", ".join(part for part in (error.context, error.problem) if part)
            raise InputError(f"{path}:{mark.line + 1 if mark else 1}: {what}: {problem}") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}:1: {what}: expected key: value")
    return {str(key): value for key, value in content.items() if value is not None}

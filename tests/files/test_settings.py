"""What models say of their settings."""

import math
from typing import Annotated, Literal

import pytest
from pydantic import Field

from factorgraph_loc.files.models import FileModel, InUnit
from factorgraph_loc.files.settings import default_text, settings_in, values_text


class Growth(FileModel):
    """A part."""

    per_time: Annotated[float, Field(ge=0.0, le=5.0), InUnit("m")] = 0.0
    """growth, on
    two lines"""


class Beam(FileModel):
    """One alternative."""

    kind: Literal["beam"] = "beam"
    reach: Annotated[float, Field(gt=0.0, le=math.pi), InUnit("rad")]


class Grid(FileModel):
    """Another. With a second sentence."""

    kind: Literal["grid"] = "grid"
    file: str


class Everything(FileModel):
    """All kinds of fields."""

    count: Annotated[int, Field(ge=1, le=9)] | None = None
    on: bool = True
    growth: Growth = Growth(per_time=0.5)
    models: dict[str, Beam | Grid] = Field(default_factory=dict)
    """detection models by name"""
    line: tuple[Annotated[float, Field(ge=0.0, le=1.0)], ...] = (0.5, 1.0)
    pair: tuple[int, int] = (1, 2)


@pytest.fixture
def found():
    return {setting.key: setting for setting in settings_in(Everything)}


def test_a_setting_has_bounds_unit_and_meaning(found):
    growth = found["growth.per_time"]
    assert (growth.low, growth.high, growth.unit, growth.default) == (0.0, 5.0, "m", 0.5)
    assert growth.meaning == "growth, on two lines"
    assert found["models"].kind == "table"
    assert found["models.*.kind"].choices == ("beam", "grid")
    assert found["models.*.file"].required


def test_settings_in_words(found):
    words = {key: (default_text(setting), values_text(setting)) for key, setting in found.items()}
    assert words == {
        "count": ("-", "1 to 9, whole"),
        "on": ("true", "true or false"),
        "growth.per_time": ("0.5", "0 to 5 m"),
        "models": ("-", "table"),
        "models.*.kind": ("beam", "beam, grid"),
        "models.*.reach": ("required", "above 0 to pi rad"),
        "models.*.file": ("required", "text"),
        "line": ("[0.5, 1]", "a list of any number: 0 to 1"),
        "pair": ("[1, 2]", "a list of 2: whole number"),
    }

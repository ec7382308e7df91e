"""The estimators by name, and how one is made for a run."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, nearest, parse_model
from factorgraph_loc.fusion.base import Estimator, SpaceEstimator
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.plugins import ESTIMATORS, load
from factorgraph_loc.text import quoted


def settings_of(name: str, overrides: Mapping[str, Any]) -> FileModel:
    """The frozen settings of an estimator; ``overrides`` by dotted key without the estimator's name.

    Raises InputError for an unknown estimator, an unknown key or a value out of bounds.
    """
    return parse_model(settings_type(name), overrides, f"settings of {name}")


def create(name: str, setup: Setup, settings: FileModel) -> Estimator:
    """An estimator by name."""
    return cast(Estimator, estimator_type(name)(setup, settings))


def check_names(names: Sequence[str]) -> None:
    """InputError for the first name that is no estimator, with the nearest that is."""
    for name in names:
        if name not in ESTIMATORS:
            raise InputError(f"no estimator is called {quoted(name)}{nearest(name, list(ESTIMATORS))}")


def in_space() -> list[str]:
    """The names of those for a robot that need not be on a floor."""
    return [name for name in ESTIMATORS if issubclass(estimator_type(name), SpaceEstimator)]


def estimator_type(name: str) -> type[Any]:
    """The class of an estimator; InputError for an unknown one."""
    check_names([name])
    return cast(type[Any], ESTIMATORS[name])


def settings_type(name: str) -> type[FileModel]:
    """The class of its settings: beside it, ``EkfSettings`` of ``Ekf``. InputError for an unknown estimator."""
    check_names([name])
    return cast(type[FileModel], load(f"{ESTIMATORS.place(name)}Settings"))

"""The estimators by name, and how one is made for a run."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import Any, cast

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, nearest, parse_model
from factorgraph_loc.fusion.base import Estimator
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.text import quoted

# by name: module, class of the estimator and class of its settings; imported when asked for
ESTIMATORS = {
    "dead_reckoning": ("factorgraph_loc.fusion.dead_reckoning", "DeadReckoning", "DeadReckoningSettings"),
    "ekf": ("factorgraph_loc.fusion.ekf", "Ekf", "EkfSettings"),
    "particle_filter": ("factorgraph_loc.fusion.particle_filter", "ParticleFilter", "ParticleFilterSettings"),
    "switching": ("factorgraph_loc.fusion.switching", "Switching", "SwitchingSettings"),
    "monoslam": ("factorgraph_loc.slam.monoslam", "Monoslam", "MonoslamSettings"),
    "smoother": ("factorgraph_loc.fusion.smoother", "Smoother", "SmootherSettings"),
    "batch": ("factorgraph_loc.fusion.batch", "Batch", "BatchSettings"),
    "space_batch": ("factorgraph_loc.slam.space_batch", "SpaceBatch", "SpaceBatchSettings"),
}

IN_SPACE = ("monoslam", "space_batch")  # those of a robot that need not be on a floor


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


def estimator_type(name: str) -> type[Any]:
    """The class of an estimator; InputError for an unknown one."""
    return _load(name, 1)


def settings_type(name: str) -> type[FileModel]:
    """The class of its settings; InputError for an unknown estimator."""
    return _load(name, 2)


def _load(name: str, which: int) -> type[Any]:
    check_names([name])
    entry = ESTIMATORS[name]
    return cast(type[Any], getattr(importlib.import_module(entry[0]), entry[which]))

"""The estimators by name, their descriptions and settings, and their construction for a run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel, nearest, parse_model
from factorgraph_loc.files.settings import Setting, first_sentence, settings_in
from factorgraph_loc.fusion.base import EVERY, Estimator
from factorgraph_loc.model.setup import Setup
from factorgraph_loc.plugins import ESTIMATORS, load
from factorgraph_loc.sensors.registry import Channel, channels, parent_of
from factorgraph_loc.text import quoted


@dataclass(frozen=True)
class Description:
    """An estimator. ``about``: one sentence; ``sensors``: channels that it uses; ``causal``: whether it has estimates during a
    run; ``smoothed``: whether its final trajectory uses all measurements; ``settings``: all its
    settings."""

    name: str
    about: str
    sensors: tuple[str, ...]
    causal: bool
    smoothed: bool
    settings: tuple[Setting, ...]


def settings_of(name: str, overrides: Mapping[str, Any]) -> FileModel:
    """The frozen settings of an estimator; ``overrides`` by dotted key without the estimator's name.

    Raises InputError for an unknown estimator, an unknown key or a value out of bounds.
    """
    return parse_model(settings_type(name), overrides, f"settings of {name}")


def create(name: str, setup: Setup, settings: FileModel) -> Estimator:
    """An estimator by name."""
    return cast(Estimator, estimator_type(name)(setup, settings))


def describe(name: str) -> Description:
    """The description of an estimator; InputError for an unknown one."""
    kind = estimator_type(name)
    taken = tuple(channel.name for channel in channels().values() if _takes(kind, channel))
    return Description(
        name,
        first_sentence(kind),
        taken,
        getattr(kind, "causal", True),
        getattr(kind, "smoothed", True),
        tuple(settings_in(settings_type(name))),
    )


def _takes(kind: type[Any], channel: Channel) -> bool:
    modalities = getattr(kind, "modalities", EVERY)
    streams = channels()[parent_of(channel.name) or channel.name].streams
    return any(stream.kind.is_motion or stream.kind.modality in modalities for stream in streams)


def check_names(names: Sequence[str]) -> None:
    """InputError for the first name that is no estimator, with the nearest that is."""
    for name in names:
        if name not in ESTIMATORS:
            raise InputError(f"no estimator is called {quoted(name)}{nearest(name, list(ESTIMATORS))}")


def estimator_type(name: str) -> type[Any]:
    """The class of an estimator; InputError for an unknown one."""
    check_names([name])
    return cast(type[Any], ESTIMATORS[name])


def settings_type(name: str) -> type[FileModel]:
    """The class of its settings in the same module, ``EkfSettings`` of ``Ekf``. InputError for an unknown estimator."""
    check_names([name])
    return cast(type[FileModel], load(f"{ESTIMATORS.place(name)}Settings"))

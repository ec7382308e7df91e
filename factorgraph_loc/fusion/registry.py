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
    """The description of an estimator for users.

    ``name``: the name of its class. ``about``: one sentence. ``sensors``: the names of the sensor channels that the
    estimator uses. ``causal``: True if the estimator has estimates during a run. ``smoothed``: True if its final
    trajectory uses all measurements. ``settings``: all its settings.
    """

    name: str
    about: str
    sensors: tuple[str, ...]
    causal: bool
    smoothed: bool
    settings: tuple[Setting, ...]


def settings_of(name: str, overrides: Mapping[str, Any]) -> FileModel:
    """Return the settings of the estimator ``name``: the defaults, changed by ``overrides``.

    ``overrides``: {key: value}, such as {"lag": 10.0}. The parts of a nested key are separated by dots. Raises
    InputError if the estimator or a key is unknown, or if a value is out of bounds.
    """
    return parse_model(settings_type(name), overrides, f"settings of {name}")


def create(name: str, setup: Setup, settings: FileModel) -> Estimator:
    """Return a new estimator. ``name``: the name of its class. ``setup``: the robot, the map, the sensors to use, and a
    random generator. ``settings``: the settings of the estimator."""
    return cast(Estimator, estimator_type(name)(setup, settings))


def describe(name: str) -> Description:
    """Return the description of the estimator with this name. Raises InputError if the name is unknown."""
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
    """Return True if an estimator class uses the measurements of a channel."""
    modalities = getattr(kind, "modalities", EVERY)
    streams = channels()[parent_of(channel.name) or channel.name].streams
    return any(stream.kind.is_motion or stream.kind.modality in modalities for stream in streams)


def check_names(names: Sequence[str]) -> None:
    """Raise InputError if an element of ``names`` is not the name of an estimator. The message proposes the most
    similar name."""
    for name in names:
        if name not in ESTIMATORS:
            raise InputError(f"no estimator is called {quoted(name)}{nearest(name, list(ESTIMATORS))}")


def estimator_type(name: str) -> type[Any]:
    """Return the class of the estimator with this name. Raises InputError if the name is unknown."""
    check_names([name])
    return cast(type[Any], ESTIMATORS[name])


def settings_type(name: str) -> type[FileModel]:
    """Return the settings class of the estimator with this name, such as ``EkfSettings`` in the module of ``Ekf``.
    Raises InputError if the name is unknown."""
    check_names([name])
    return cast(type[FileModel], load(f"{ESTIMATORS.place(name)}Settings"))

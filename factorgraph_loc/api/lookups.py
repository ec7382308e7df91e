"""The commands ``fgloc estimators``, ``sensors``, ``readers``, ``presets``, ``policies`` and ``rigs`` as functions.

They list the available choices.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.columns import Column
from factorgraph_loc.files.models import write_text
from factorgraph_loc.files.settings import Setting, first_sentence, settings_in
from factorgraph_loc.files.shipped import rigs as shipped
from factorgraph_loc.fusion.registry import Description, describe
from factorgraph_loc.io.native import rig_file as first
from factorgraph_loc.io.native.rig_file import DEFAULT_RIG, read_rig, rig_text
from factorgraph_loc.io.readers import reader
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.planning.settings import ActiveSettings
from factorgraph_loc.plugins import ESTIMATORS, POLICIES, PRESETS, READERS, SENSORS
from factorgraph_loc.sensors.registry import about, sections_of, sensor
from factorgraph_loc.sensors.tables import all_tables
from factorgraph_loc.simulation.settings import SimulationSettings, preset

ADVICE = "`fgloc sensors NAME` prints all keys of a sensor, with bounds."


@dataclass(frozen=True)
class NamedSettings:
    """A reader of logs, a preset of simulations, or a policy of active localization. ``about``: its description.

    ``settings``: the options of the reader, or the settings of the preset without those of the rig. For a policy, the
    settings that all policies share.
    """

    name: str
    about: str
    settings: tuple[Setting, ...]


@dataclass(frozen=True)
class SensorDescription:
    """A sensor. ``about``: its description. ``channels``: the names of its measurements, for the option ``--sensors``.

    ``tables``: the columns of each table by its name. ``rig``: the settings of each section of the rig by its name.
    """

    name: str
    about: str
    channels: tuple[str, ...]
    tables: Mapping[str, tuple[Column, ...]]
    rig: Mapping[str, tuple[Setting, ...]]


def known_estimators() -> list[Description]:
    """Return a description of each estimator: the sensors that it uses, and its settings."""
    return [describe(name) for name in ESTIMATORS]


def known_readers() -> list[NamedSettings]:
    """Return a description of each reader of logs, with its options."""
    return [describe_reader(name) for name in READERS]


def describe_reader(name: str) -> NamedSettings:
    """Return the description of the reader ``name``. Raises InputError if there is no such reader."""
    module = reader(name)
    return NamedSettings(name, first_sentence(module), tuple(settings_in(module.Options)))


def known_sensors() -> list[SensorDescription]:
    """Return a description of each sensor, with the columns of its tables and its settings in the rig."""
    return [describe_sensor(name) for name in SENSORS]


def describe_sensor(name: str) -> SensorDescription:
    """Return the description of a sensor. ``name``: its name ("rfid"), or that of some of its measurements ("rssi").

    Raises InputError if there is no such sensor.
    """
    described = sensor(name)
    tables: dict[str, dict[str, Column]] = {}
    for table in all_tables(described):  # several tables with one name are alternatives
        tables.setdefault(table.name, {}).update({column.name: column for column in table.columns})
    return SensorDescription(
        described.name,
        about(described.name),
        tuple(channel.name for channel in described.channels),
        {name: tuple(columns.values()) for name, columns in tables.items()},
        {section: tuple(settings) for section, settings in sections_of(described).items()},
    )


def known_presets() -> list[NamedSettings]:
    """Return a description of each preset of simulations, with its settings."""
    return [describe_preset(name) for name in PRESETS]


def describe_preset(name: str) -> NamedSettings:
    """Return the description of a preset of simulations. Raises InputError if there is no such preset."""
    settings = settings_in(SimulationSettings, default=preset(name))
    return NamedSettings(name, PRESETS[name], tuple(s for s in settings if not s.key.startswith("rig.")))


def known_policies() -> list[NamedSettings]:
    """Return a description of each policy of active localization, with the settings that all policies share."""
    settings = tuple(settings_in(ActiveSettings))
    return [NamedSettings(name, about, settings) for name, about in POLICIES.items()]


def known_rigs() -> dict[str, Rig]:
    """Return the rigs of known logs and of simulations, and the default rig, by name."""
    return {name: make() for name, (_, make) in sources_of_rigs().items()}


def sources_of_rigs() -> dict[str, tuple[str, Callable[[], Rig]]]:
    """Return (text, function) for each known rig, by its name.

    The text states which logs the rig is for. The function takes no arguments and returns the rig.
    """
    default: dict[str, tuple[str, Callable[[], Rig]]] = {"default": ("logs without a rig", lambda: DEFAULT_RIG)}
    recorded = {name: ("a known log", partial(read_rig, file)) for name, file in shipped().items()}
    return default | recorded | {name: ("fgloc simulate", lambda name=name: preset(name).rig) for name in PRESETS}


def new_rig(
    name: str = "robot",
    *,
    odometry: first.Drive = "differential",
    imu: bool = False,
    landmarks: float | Mapping[str, float] | None = None,
    antennas: int | Sequence[str] = 0,
    camera: tuple[int, int] | str | None = None,
    position: float | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
) -> Rig:
    """Return a rig, the settings of a robot and its sensors, with typical values. ``out``: a file to write it to.

    ``odometry``: the type of drive. ``imu``: True if the robot has a gyro. ``landmarks``: standard deviation of ranges
    to landmarks [m], or a dict of values by sensor name. ``antennas``: number or names of RFID antennas. ``camera``:
    width and height of its images [px], or the file of a camera chain of Kalibr. ``position``: standard deviation of
    measured positions [m]. Raises InputError if a value is out of bounds, or if the file exists without ``overwrite``.
    """
    names = tuple(map(str, range(1, antennas + 1))) if isinstance(antennas, int) else tuple(antennas)
    rig, remarks = first.new_rig(name, first.RobotOptions(odometry, imu, landmarks, names, camera, position))
    if out is not None:
        write_new_rig(rig, remarks, Path(out), overwrite=overwrite)
    return rig


def write_new_rig(rig: Rig, remarks: list[str], file: Path, *, overwrite: bool) -> None:
    """Write a rig with a comment on each key. ``remarks``: comments at the beginning of the file.

    Raises InputError if the file exists and ``overwrite`` is False.
    """
    if file.exists() and not overwrite:
        raise InputError(f"{file}: exists already: choose another name, or use --overwrite")
    write_text(file, rig_text(rig, [ADVICE, *remarks]))

"""Sensors, estimators and readers of other packages, found by their entry points; and our own."""

import subprocess
import sys
from importlib import metadata
from types import ModuleType, SimpleNamespace

import pytest

from factorgraph_loc.errors import InputError
from factorgraph_loc.files.models import FileModel
from factorgraph_loc.fusion import registry as estimators
from factorgraph_loc.io.readers import reader
from factorgraph_loc.model.sections import Section, registered
from factorgraph_loc.plugins import ESTIMATORS, READERS, SENSORS, load
from factorgraph_loc.sensors import registry
from factorgraph_loc.sensors.registry import Channel, SensorType

SONAR = SensorType("sonar", (Channel("sonar", section="sonar"),), {"sonar": Section("sonar:Settings")})


def search_again():
    """The next access searches for entry points again."""
    for kind in (ESTIMATORS, READERS, SENSORS):
        kind._others = None
    for function in (registered, registry.channels, registry.sensor_of):
        function.cache_clear()


@pytest.fixture
def install(monkeypatch):
    """Puts entry points (group, name, place) of a package ``sonar-package`` in front of those that are installed."""
    installed = metadata.entry_points

    def put(*entries):
        found = [
            SimpleNamespace(group=f"factorgraph_loc.{group}", name=name, value=place, dist=SimpleNamespace(name=of))
            for group, name, place, of in ((*entry, "sonar-package")[:4] for entry in entries)
        ]
        monkeypatch.setattr(
            metadata,
            "entry_points",
            lambda *, group: [*(e for e in found if e.group == group), *installed(group=group)],
        )
        search_again()

    yield put
    monkeypatch.undo()
    search_again()


@pytest.fixture
def sonar(monkeypatch):
    """A module ``sonar`` with a sensor, an estimator and what a reader needs."""
    module = ModuleType("sonar")
    module.SENSOR, module.Options, module.read = SONAR, type("Options", (FileModel,), {}), print
    module.Guess, module.GuessSettings = (
        type("Guess", (), {"process": print, "estimate": print}),
        type("GuessSettings", (FileModel,), {}),
    )
    monkeypatch.setitem(sys.modules, "sonar", module)
    return module


@pytest.mark.usefixtures("sonar")
def test_a_sensor_of_another_package_stands_behind_ours(install):
    before = list(registry.sensors())
    install(("sensors", "sonar", "sonar:SENSOR"))
    assert list(registry.sensors()) == [*before, "sonar"]
    assert registry.sensor_of("sonar") is SONAR
    assert "sonar" in registry.channels()


def test_estimators_and_readers_of_another_package(install, sonar):
    install(("estimators", "guess", "sonar:Guess"), ("readers", "sonar_log", "sonar"))
    assert estimators.estimator_type("guess") is sonar.Guess
    assert isinstance(estimators.settings_of("guess", {}), sonar.GuessSettings)
    assert reader("sonar_log").read is print
    sonar.Guess.__doc__, sonar.Guess.modalities, sonar.Guess.causal = "Guesses. Often.", {"rfid"}, False
    found = estimators.describe("guess")
    assert (found.about, found.causal, found.smoothed) == ("Guesses.", False, True)
    assert found.sensors == ("odometry", "imu", "rfid", "rssi", "phase")


@pytest.mark.parametrize(
    ("place", "why"),
    [
        ("no_such_package:SENSOR", "No module named 'no_such_package'"),
        ("sonar:LIDAR", "module 'sonar' has no attribute 'LIDAR'"),
    ],
)
@pytest.mark.usefixtures("sonar")
def test_what_cannot_be_loaded_is_one_line(install, place, why):
    install(("sensors", "sonar", place))
    with pytest.raises(InputError) as error:
        registry.sensors()
    assert str(error.value) == f"sensors: sonar of sonar-package cannot be loaded from {place}: {why}"


def test_a_name_stands_for_one_thing(install, sonar):
    install(("estimators", "ekf", "sonar:Guess"))
    with pytest.raises(
        InputError, match=r"^estimators: sonar-package registers ekf, which this project already registers$"
    ):
        list(ESTIMATORS)
    install(("readers", "sonar_log", "sonar"), ("readers", "sonar_log", "sonar", "echo"))
    with pytest.raises(InputError, match=r"^readers: echo registers sonar_log, which sonar-package already registers$"):
        list(READERS)
    sonar.SENSOR = SensorType("sonar", (Channel("sightings"),))
    install(("sensors", "sonar", "sonar:SENSOR"))
    with pytest.raises(InputError, match=r"^sensors: sonar and camera both have the channel sightings$"):
        registry.sensors()


@pytest.mark.parametrize("name", SENSORS.own)
def test_all_that_ours_name_is_there(name):
    sensor = registry.sensors()[name]
    assert sensor.name == name
    for channel in sensor.channels:
        assert channel.section in (*sensor.settings, "")
        for stream in channel.streams:
            assert callable(stream.measurements)
            measurement = stream.kind
            assert isinstance(measurement.sensor, property) or measurement.sensor == channel.name
            assert isinstance(measurement.is_motion, bool)
    for section in (*sensor.settings.values(), *sensor.layers.values()):
        assert issubclass(load(section.kind), FileModel)


def test_asking_what_there_is_loads_no_sensor():
    code = (
        "import sys\n"
        "from factorgraph_loc.sensors import registry\n"
        "assert registry.sensor_of('sightings').name == 'camera'\n"
        "print(sorted({'numpy', 'gtsam', 'scipy', 'cv2'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"

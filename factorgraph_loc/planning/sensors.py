"""What a robot looks with, as expectations of what it will learn see it."""

from __future__ import annotations

from dataclasses import dataclass

from factorgraph_loc.model.rig import Rig
from factorgraph_loc.model.world import World
from factorgraph_loc.sensors.camera.simulation_settings import PixelSettings
from factorgraph_loc.sensors.landmarks.simulation_settings import SightingSettings
from factorgraph_loc.sensors.odometry.model import odometry_model
from factorgraph_loc.sensors.rfid.tag_map import tag_map
from factors.camera.model import CameraModel
from factors.landmarks.model import BearingRangeModel
from factors.odometry.model import OdometryModel
from factors.rfid.detection import RfidLikelihood

ROUNDS_PER_METRE, ROUNDS_PER_RADIAN = 4.0, 2.0  # of a robot with 2 rounds a second at 0.5 m/s, or at 1 rad/s in place
SPEED = 0.5  # m/s, at which the odometry's noise that grows with time is taken
_SIGHTINGS, _PIXELS = SightingSettings(), PixelSettings()


@dataclass(frozen=True, eq=False)
class Sensors:
    """What a robot looks with on its way through ``world``, whose map is taken as exact. ``odometry``: noise of its motion.

    The other models are None where there is no such sensor. ``rounds_per_metre``: inventory rounds of each antenna;
    ``looks_per_metre``: of the other sensors; ``metres_per_radian``: that take as long as a turn in place. Landmarks are seen as
    ``sightings`` tells but for the rate, at most ``max_points`` points up to ``max_depth`` [m], neither through walls.
    """

    world: World
    odometry: OdometryModel
    rfid: RfidLikelihood | None = None
    bearing_range: BearingRangeModel | None = None
    camera: CameraModel | None = None
    rounds_per_metre: float = ROUNDS_PER_METRE
    metres_per_radian: float = ROUNDS_PER_RADIAN / ROUNDS_PER_METRE
    looks_per_metre: float = _SIGHTINGS.rate / SPEED
    sightings: SightingSettings = _SIGHTINGS
    max_depth: float = _PIXELS.max_depth
    max_points: int = _PIXELS.max_points

    @staticmethod
    def of(world: World, rig: Rig) -> Sensors:
        """All sensors of a rig that find something in the world."""
        return Sensors(
            world,
            odometry_model(rig, constants_as_noise=True),
            RfidLikelihood(rig.rfid.model(), tag_map(world, rig.survey).tags) if rig.rfid and world.tags else None,
            rig.bearing_range.model() if rig.bearing_range and world.landmarks else None,
            rig.camera.model() if rig.camera and world.points is not None else None,
        )

"""Simulation of a log: world, drive and measurements from one seed."""

from collections.abc import Iterable
from functools import partial

import numpy as np

from factorgraph_loc.model.log import Log, StartPose
from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.registry import functions
from factorgraph_loc.sensors.rfid.recorded import RecordedLooks
from factorgraph_loc.sensors.simulated import Ride, Simulated
from factorgraph_loc.simulation.chance import generator
from factorgraph_loc.simulation.settings import SimulationSettings
from factorgraph_loc.simulation.trajectories import drive
from factorgraph_loc.simulation.worlds import make_world
from factorgraph_loc.version import __version__
from factors import se2

START_SIGMAS = np.array((0.1, 0.1, 0.05))  # m, m, rad


def simulate(settings: SimulationSettings, seed: int, recorded: RecordedLooks | None = None) -> Log:
    """Simulate a log; the same ``settings`` and ``seed`` give the same log to the last bit.

    Streams: odometry, rfid, bearing_range if the world has landmarks, sightings if it has points, and those of sensors from
    other packages. The reference is the true trajectory. The stated start is the true pose plus an error drawn from its
    covariance (:data:`START_SIGMAS`). World, drive and sensors use independent random generators. With ``recorded``, the robot
    carries the antennas of these recordings and reads what they read (:mod:`.recorded`). Raises InputError if there is no space
    for the tags or for the robot.
    """
    of_world = seed if settings.world_seed is None else settings.world_seed
    rig = settings.rig if recorded is None else recorded.carried_by(settings.rig)
    world = make_world(settings.world, generator(of_world, "world"))
    truth = drive(world, settings.drive, generator(seed, "drive"))
    ride = Ride(settings, rig, world, truth, partial(generator, seed), partial(generator, of_world), recorded)
    made: list[Simulated] = [function(ride) for _, function in functions("simulate")]
    streams = {name: stream for one in made for name, stream in one.streams.items()}
    start = truth.poses[0] + START_SIGMAS * generator(seed, "start").standard_normal(3)
    start[2] = se2.wrap_scalar(start[2])
    metadata = {"origin": f"simulated by fgloc {__version__}", "preset": settings.name, "seed": str(seed)}
    if settings.world_seed is not None:
        metadata["world_seed"] = str(settings.world_seed)
    return Log(
        name=f"{settings.name}-{seed}",
        rig=with_sensors(rig, streams),
        world=world.model_copy(update={name: layer for one in made for name, layer in one.layers.items()}),
        streams=streams,
        reference=truth,
        start=StartPose(0.0, start, START_SIGMAS.copy()),
        warnings=tuple(warning for one in made for warning in one.warnings),
        metadata=metadata | {key: value for one in made for key, value in one.metadata.items()},
    )


def with_sensors(rig: Rig, streams: Iterable[str]) -> Rig:
    """The rig with the channels of the log as the sensors that estimators use by default."""
    sensors = (*rig.sensors, *(name for name in streams if name not in rig.sensors))
    return rig.model_copy(update={"sensors": sensors})

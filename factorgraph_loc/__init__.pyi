"""The names that are imported from ``factorgraph_loc`` itself, with their types. The package reads its table of lazy imports from
this file, so that each name is listed once."""
# ruff: noqa: I001 - of each module together

from factorgraph_loc.api.learning import build_map as build_map, calibrate as calibrate, features as features
from factorgraph_loc.api.logs import (
    convert as convert,
    datasets as datasets,
    info as info,
    manifest as manifest,
    simulate as simulate,
)
from factorgraph_loc.api.lookups import (
    known_estimators as known_estimators,
    known_policies as known_policies,
    known_presets as known_presets,
    known_readers as known_readers,
    known_rigs as known_rigs,
    known_sensors as known_sensors,
    new_rig as new_rig,
)
from factorgraph_loc.api.results import export as export, score as score, view as view
from factorgraph_loc.api.running import Run as Run, run as run
from factorgraph_loc.errors import (
    FglocError as FglocError,
    InputError as InputError,
    RunFailedError as RunFailedError,
)
from factorgraph_loc.evaluation.inference import contrast as contrast
from factorgraph_loc.experiments.active import active as active
from factorgraph_loc.experiments.compare import compare as compare
from factorgraph_loc.experiments.experiment import experiment as experiment, status as status
from factorgraph_loc.experiments.reporting import report as report
from factorgraph_loc.experiments.result_table import load_results as load_results
from factorgraph_loc.io.trajectories import write_trajectory as write_trajectory
from factorgraph_loc.io.native.native import write_native as write_native
from factorgraph_loc.io.native.rig_file import read_rig as read_rig, write_rig as write_rig
from factorgraph_loc.io.native.world_file import read_world as read_world, write_world as write_world
from factorgraph_loc.io.readers.load import load as load, read_log as read_log
from factorgraph_loc.io.trajectories import (
    from_evo as from_evo,
    from_ros as from_ros,
    read_trajectory as read_trajectory,
    to_evo as to_evo,
    to_ros as to_ros,
)
from factorgraph_loc.live.localizer import Localizer as Localizer
from factorgraph_loc.maps.points import PointMap as PointMap
from factorgraph_loc.model.belief import PoseEstimate as PoseEstimate
from factorgraph_loc.model.log import Log as Log, StartPose as StartPose
from factorgraph_loc.model.measurement import Measurement as Measurement, Tick as Tick
from factorgraph_loc.model.rig import Rig as Rig
from factorgraph_loc.model.trajectory import Trajectory as Trajectory
from factorgraph_loc.model.pose_path import PosePath as PosePath
from factorgraph_loc.model.world import World as World
from factorgraph_loc.sensors.camera.measurement import PixelSightings as PixelSightings
from factorgraph_loc.sensors.camera.measurement import (
    CameraImage as CameraImage,
    FeatureStream as FeatureStream,
    ImageStream as ImageStream,
    SightingStream as SightingStream,
)
from factorgraph_loc.sensors.landmarks.measurement import (
    BearingRange as BearingRange,
    BearingRangeStream as BearingRangeStream,
)
from factorgraph_loc.sensors.landmarks.measurement import Landmark as Landmark
from factorgraph_loc.sensors.loops.measurement import LoopStream as LoopStream, Loops as Loops
from factorgraph_loc.sensors.positions.measurement import Position as Position, PositionStream as PositionStream
from factorgraph_loc.sensors.odometry.measurement import (
    IncrementOdometry as IncrementOdometry,
    IncrementStream as IncrementStream,
    VelocityOdometry as VelocityOdometry,
    VelocityStream as VelocityStream,
    YawRate as YawRate,
    YawRateStream as YawRateStream,
)
from factorgraph_loc.sensors.rfid.settings import read_grid as read_grid, write_grid as write_grid
from factorgraph_loc.sensors.rfid.map import Tag as Tag
from factorgraph_loc.sensors.rfid.stream import RfidScan as RfidScan
from factorgraph_loc.sensors.rfid.stream import RfidRead as RfidRead
from factorgraph_loc.sensors.rfid.stream import RfidStream as RfidStream
from factorgraph_loc.sensors.rfid.stream import scan_of as scan_of
from factorgraph_loc.vision.frame import CameraFrame as CameraFrame
from factorgraph_loc.version import __version__ as __version__

"""The rig of a log without one."""

from factorgraph_loc.model.rig import Rig
from factorgraph_loc.sensors.landmarks.settings import BearingRangeSettings

# for formats that do not describe the robot
DEFAULT_RIG = Rig(
    name="default",
    bearing_range=BearingRangeSettings(range_sigma=0.2, range_sigma_relative=0.1, bearing_sigma=0.05),
)

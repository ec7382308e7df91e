"""The module paths of the sensors, estimators, mappers and readers of this project, and of the functions for its files."""

from factorgraph_loc.plugins import ESTIMATORS, FILES, MAPPERS, READERS, SENSORS

SENSORS.own |= {
    "odometry": "factorgraph_loc.sensors.odometry:SENSOR",
    "landmarks": "factorgraph_loc.sensors.landmarks:SENSOR",
    "rfid": "factorgraph_loc.sensors.rfid:SENSOR",
    "camera": "factorgraph_loc.sensors.camera:SENSOR",
    "loops": "factorgraph_loc.sensors.loops:SENSOR",
}
ESTIMATORS.own |= {
    "dead_reckoning": "factorgraph_loc.fusion.dead_reckoning:DeadReckoning",
    "ekf": "factorgraph_loc.fusion.ekf:Ekf",
    "particle_filter": "factorgraph_loc.fusion.particle_filter:ParticleFilter",
    "switching": "factorgraph_loc.fusion.switching:Switching",
    "monoslam": "factorgraph_loc.slam.monoslam:Monoslam",
    "smoother": "factorgraph_loc.fusion.smoother:Smoother",
    "batch": "factorgraph_loc.fusion.batch:Batch",
}
MAPPERS.own["points"] = "factorgraph_loc.slam.point_mapper:bind"
READERS.own |= {
    "native": "factorgraph_loc.io.native.native",
    "mapped": "factorgraph_loc.io.readers.mapped",
    "mrclam": "factorgraph_loc.io.readers.mrclam",
    "plaza": "factorgraph_loc.io.readers.plaza",
    "rosbag": "factorgraph_loc.io.bags.rosbag",
    "trajectory": "factorgraph_loc.io.readers.trajectory",
}
FILES |= {
    "read_rig": "factorgraph_loc.io.native.rig_file:read_rig",
    "write_rig": "factorgraph_loc.io.native.rig_file:write_rig",
    "read_world": "factorgraph_loc.io.native.world_file:read_world",
    "write_world": "factorgraph_loc.io.native.world_file:write_world",
    "read_trajectory": "factorgraph_loc.io.trajectories:read_trajectory",
    "write_kitti": "factorgraph_loc.exports.trajectories:write_kitti",
    "to_evo": "factorgraph_loc.io.trajectories:to_evo",
    "from_evo": "factorgraph_loc.io.trajectories:from_evo",
    "to_ros": "factorgraph_loc.io.trajectories:to_ros",
    "from_ros": "factorgraph_loc.io.trajectories:from_ros",
}

"""The module paths of the sensors, estimators, mappers and readers of this project."""

from factorgraph_loc.plugins import ESTIMATORS, MAPPERS, READERS, SENSORS

SENSORS.own |= {
    "odometry": "factorgraph_loc.sensors.odometry:SENSOR",
    "landmarks": "factorgraph_loc.sensors.landmarks:SENSOR",
    "rfid": "factorgraph_loc.sensors.rfid:SENSOR",
    "camera": "factorgraph_loc.sensors.camera:SENSOR",
    "positions": "factorgraph_loc.sensors.positions:SENSOR",
    "loops": "factorgraph_loc.sensors.loops:SENSOR",
}
ESTIMATORS.own |= {
    "dead_reckoning": "factorgraph_loc.fusion.dead_reckoning:DeadReckoning",
    "ekf": "factorgraph_loc.fusion.ekf:Ekf",
    "particle_filter": "factorgraph_loc.fusion.particle_filter:ParticleFilter",
    "switching": "factorgraph_loc.fusion.switching:Switching",
    "monoslam": "factorgraph_loc.slam.monoslam:Monoslam",
    "smoother": "factorgraph_loc.fusion.graph.estimator:Smoother",
    "batch": "factorgraph_loc.fusion.graph.estimator:Batch",
}
MAPPERS.own["points"] = "factorgraph_loc.slam.point_mapper:bind"
READERS.own |= {
    "native": "factorgraph_loc.io.native.native",
    "mapped": "factorgraph_loc.io.readers.mapped",
    "mrclam": "factorgraph_loc.io.readers.mrclam",
    "plaza": "factorgraph_loc.io.readers.plaza",
    "pyfg": "factorgraph_loc.io.readers.pyfg",
    "rosbag": "factorgraph_loc.io.bags.rosbag",
}

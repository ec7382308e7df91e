"""Message types of exported logs: those of ROS where available, else our own, with a field for each column of a table."""

from collections.abc import Mapping

from factorgraph_loc.files.columns import Table
from factorgraph_loc.sensors.tables import native_tables

OURS = "factorgraph_loc_msgs/msg/"
NAMED = {"bearing_range": f"{OURS}LandmarkSighting", "sightings": f"{OURS}PixelSighting"}
ROS_HAS = ("odometry", "imu", "camera", "rfid", "inventories")  # tables that are exported differently
READ, ROUND = f"{OURS}RfidRead", f"{OURS}RfidRound"
INITIAL_POSE = ("/initialpose", "geometry_msgs/msg/PoseWithCovarianceStamped")

LINE = "=" * 80
KINDS = {"number": "float64", "whole": "int64", "name": "string", "file": "string"}


def tables_of_messages() -> Mapping[str, Table]:
    """The tables whose rows are messages of our own, by message type."""
    return {
        NAMED.get(name) or OURS + "".join(part.capitalize() for part in name.split("_")): tables[0]
        for name, (_, tables) in native_tables().items()
        if name not in ROS_HAS
    }


def definitions() -> dict[str, str]:
    """Definitions of our own message types; ``{time}`` is replaced by the type of a timestamp."""
    rows = {
        kind: "std_msgs/Header header\n" + "".join(f"{KINDS[c.kind]} {c.name}\n" for c in table.columns[1:])
        for kind, table in tables_of_messages().items()
    }
    return rows | {
        # timestamped at the end of the round; without reads if none was read
        ROUND: "std_msgs/Header header\nstring antenna\nRfidRead[] reads\n"
        f"{LINE}\nMSG: factorgraph_loc_msgs/RfidRead\n"
        "{time} stamp\nstring epc\nfloat64 rssi\nfloat64 phase\nfloat64 frequency\n",
    }

"""The messages that our own logs become in a bag: those of ROS where it has one for the purpose, and three of our own."""

LANDMARK = "factorgraph_loc_msgs/msg/LandmarkSighting"
PIXEL = "factorgraph_loc_msgs/msg/PixelSighting"
ROUND = "factorgraph_loc_msgs/msg/RfidRound"
INITIAL_POSE = ("/initialpose", "geometry_msgs/msg/PoseWithCovarianceStamped")

LINE = "=" * 80
DEFINITIONS = {
    LANDMARK: "std_msgs/Header header\nstring landmark\nfloat64 range\nfloat64 bearing\n",
    PIXEL: "std_msgs/Header header\nstring landmark\nfloat64 u\nfloat64 v\n",
    # stamped at the end of the round; one that read nothing holds no reads
    ROUND: "std_msgs/Header header\nstring antenna\nRfidRead[] reads\n"
    f"{LINE}\nMSG: factorgraph_loc_msgs/RfidRead\n"
    "{time} stamp\nstring epc\nfloat64 rssi\nfloat64 phase\nfloat64 frequency\n",
}
READ = "factorgraph_loc_msgs/msg/RfidRead"

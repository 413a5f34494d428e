"""Writes a ROS bag with three images, depth images and poses of a body that carries the camera, 50 ms apart.

usage: write_bag.py FOLDER ros1|sqlite3|mcap
"""

import pathlib
import sys

import numpy
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer as Writer2
from rosbags.typesys import Stores, get_typestore

folder, kind = pathlib.Path(sys.argv[1]), sys.argv[2]
store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
types = store.types


def header(tick):
    stamp = types["builtin_interfaces/msg/Time"](sec=1_700_000_000, nanosec=50_000_000 * tick + 5)
    sequence = {"seq": 0} if kind == "ros1" else {}
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **sequence)


def image(tick, encoding, pixels, padding):
    """An image whose rows end with some unused bytes."""
    height, width = pixels.shape[:2]
    rows = numpy.ascontiguousarray(pixels).view(numpy.uint8).reshape(height, -1)
    rows = numpy.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    return types["sensor_msgs/msg/Image"](
        header=header(tick), height=height, width=width, encoding=encoding, is_bigendian=0, step=rows.shape[1], data=rows.reshape(-1)
    )


def messages(tick):
    blue = numpy.zeros((48, 64, 3), numpy.uint8)
    blue[:, :, 0] = 200
    yield "/image", image(tick, "bgr8", blue, 8)
    depth_m = numpy.full((48, 64), 1.5, numpy.float32)
    depth_m[0, 0] = numpy.nan
    yield "/depth", image(tick, "32FC1", depth_m, 4)
    kinds = [types[f"geometry_msgs/msg/{name}"] for name in ["Point", "Quaternion", "Pose", "PoseWithCovariance"]]
    point, quaternion, pose, with_covariance = kinds
    # The body is rotated by 90 degrees about z.
    half = 0.5**0.5
    body = pose(position=point(x=1.0 + tick, y=2.0, z=3.0), orientation=quaternion(x=0.0, y=0.0, z=half, w=half))
    covariance = numpy.zeros(36)
    vector = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    twist = types["geometry_msgs/msg/Twist"](linear=vector, angular=vector)
    yield "/odom", types["nav_msgs/msg/Odometry"](
        header=header(tick),
        child_frame_id="base",
        pose=with_covariance(pose=body, covariance=covariance),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=covariance),
    )
    region = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    names = str.upper if kind == "ros1" else str.lower
    lens = {
        "d": numpy.array([0.1, -0.02, 0.001, 0.002, 0.0]),
        "k": numpy.array([50.0, 0, 31.5, 0, 51.0, 23.5, 0, 0, 1]),
        "r": numpy.eye(3).reshape(-1),
        "p": numpy.zeros(12),
    }
    yield "/info", types["sensor_msgs/msg/CameraInfo"](
        header=header(tick), height=48, width=64, distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=region,
        **{names(name): value for name, value in lens.items()},
    )


path = folder / ("scan.bag" if kind == "ros1" else "scan")
if kind == "ros1":
    writer = Writer1(path)
else:
    writer = Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3)
with writer:
    connections = {}
    for tick in range(3):
        for topic, message in messages(tick):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
            serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
            writer.write(connections[topic], 1_700_000_000 * 10**9 + 50_000_000 * tick, serialize(message, message.__msgtype__))

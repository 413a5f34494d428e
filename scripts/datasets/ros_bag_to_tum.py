#!/usr/bin/env python3
"""Converts a ROS bag with images and camera poses to a TUM RGB-D folder, which `fieldrig train` reads. Needs no ROS.

    pip install rosbags numpy pillow
    scripts/datasets/ros_bag_to_tum.py scan.bag out --image /camera/color/image_raw --pose /camera/pose \\
        --camera-info /camera/color/camera_info --depth /camera/aligned_depth_to_color/image_raw

The bag is a file of ROS 1, or a folder or .mcap file of ROS 2. Poses are PoseStamped, PoseWithCovarianceStamped,
TransformStamped or Odometry messages of the color camera's optical frame (x right, y down, z forward). If they are poses
of another body, such as a base, give the pose of the camera in its frame as --camera-in-body x y z qx qy qz qw.
Depth images must be aligned to the color images.
"""

import argparse
import io
import math
import os
import sys

# TUM RGB-D stores depth with this many counts per meter.
COUNTS_PER_METER = 5000
# Bytes per pixel and order of the channels of the encodings of sensor_msgs/Image.
COLORS = {"rgb8": (3, [0, 1, 2]), "bgr8": (3, [2, 1, 0]), "rgba8": (4, [0, 1, 2]), "bgra8": (4, [2, 1, 0]), "mono8": (1, [0, 0, 0])}


def seconds(stamp):
    """A stamp as text with nanoseconds, because a float has too few digits."""
    return f"{stamp.sec}.{stamp.nanosec:09d}"


def rows_of(message, dtype):
    """The pixels of a raw image as rows without padding, in the byte order of this computer."""
    import numpy

    dtype = numpy.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    rows = numpy.frombuffer(message.data, numpy.uint8).reshape(message.height, message.step)
    n_bytes = rows.shape[1] // dtype.itemsize * dtype.itemsize
    return numpy.ascontiguousarray(rows[:, :n_bytes]).view(dtype)


def color_image(message):
    """A color image of Pillow, from an Image or a CompressedImage."""
    from PIL import Image

    if "CompressedImage" in message.__msgtype__:
        return Image.open(io.BytesIO(message.data.tobytes())).convert("RGB")
    if message.encoding not in COLORS:
        sys.exit(f"error: images have the encoding {message.encoding}, expected {', '.join(COLORS)}")
    n_channels, order = COLORS[message.encoding]
    pixels = rows_of(message, "u1")[:, : message.width * n_channels]
    return Image.fromarray(pixels.reshape(message.height, message.width, n_channels)[:, :, order].copy())


def depth_image(message):
    """A depth image of Pillow with 16 bits. 0 means unknown."""
    import numpy
    from PIL import Image

    scales = {"16UC1": ("u2", 0.001), "mono16": ("u2", 0.001), "32FC1": ("f4", 1.0)}
    if getattr(message, "encoding", "compressed") not in scales:
        sys.exit(f"error: depth images are {getattr(message, 'encoding', 'compressed')}, expected {', '.join(scales)}")
    dtype, meters_per_count = scales[message.encoding]
    depth_m = rows_of(message, dtype)[:, : message.width].astype(float) * meters_per_count
    counts = numpy.nan_to_num(depth_m * COUNTS_PER_METER, nan=0.0, posinf=0.0, neginf=0.0)
    # Depth beyond the range of 16 bits is unknown.
    counts[(counts < 0) | (counts > 65535)] = 0
    return Image.fromarray(counts.round().astype(numpy.uint16))


def pose_of(message):
    """Position and quaternion (x, y, z, w) of a message."""
    inner = message
    while hasattr(inner, "pose"):
        inner = inner.pose
    if hasattr(inner, "transform"):
        position, rotation = inner.transform.translation, inner.transform.rotation
    elif hasattr(inner, "position"):
        position, rotation = inner.position, inner.orientation
    else:
        sys.exit(f"error: {message.__msgtype__} contains no pose, expected PoseStamped, TransformStamped or Odometry")
    return [position.x, position.y, position.z], [rotation.x, rotation.y, rotation.z, rotation.w]


def product(a, b):
    """The product of two poses."""
    (ax, ay, az), (x1, y1, z1, w1) = a
    (bx, by, bz), (x2, y2, z2, w2) = b
    # Rotation of b's position by the quaternion of a.
    tx, ty, tz = 2 * (y1 * bz - z1 * by), 2 * (z1 * bx - x1 * bz), 2 * (x1 * by - y1 * bx)
    position = [
        ax + bx + w1 * tx + y1 * tz - z1 * ty,
        ay + by + w1 * ty + z1 * tx - x1 * tz,
        az + bz + w1 * tz + x1 * ty - y1 * tx,
    ]
    rotation = [
        w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
        w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
    ]
    length = math.sqrt(sum(value * value for value in rotation))
    return position, [value / length for value in rotation]


def calibration(message):
    """The line of calibration.txt for a CameraInfo. In both, the center of the first pixel is (0, 0)."""
    k = message.k if hasattr(message, "k") else message.K
    d = list(message.d if hasattr(message, "d") else message.D)
    if message.distortion_model not in ("plumb_bob", "") or len(d) > 5:
        sys.exit(f"error: the lens has the model {message.distortion_model}, expected plumb_bob: rectify the images with image_proc")
    return " ".join(repr(float(value)) for value in [k[0], k[4], k[2], k[5], *d, *[0.0] * (5 - len(d))])


class Writer:
    """Writes the folder while the bag is read."""

    def __init__(self, folder, camera_in_body):
        self.folder = folder
        self.camera_in_body = (camera_in_body[:3], camera_in_body[3:])
        self.lists = {name: [] for name in ["rgb", "depth", "groundtruth", "calibration"]}
        for name in ["rgb", "depth"]:
            os.makedirs(os.path.join(folder, name))

    def image(self, name, image, stamp):
        path = f"{name}/{stamp}.png"
        image.save(os.path.join(self.folder, path))
        self.lists[name].append(f"{stamp} {path}")

    def add(self, kind, message):
        if kind == "image":
            self.image("rgb", color_image(message), seconds(message.header.stamp))
        elif kind == "depth":
            self.image("depth", depth_image(message), seconds(message.header.stamp))
        elif kind == "pose":
            position, rotation = product(pose_of(message), self.camera_in_body)
            numbers = " ".join(repr(float(value)) for value in [*position, *rotation])
            self.lists["groundtruth"].append(f"{seconds(message.header.stamp)} {numbers}")
        elif not self.lists["calibration"]:
            self.lists["calibration"].append(calibration(message))

    def finish(self):
        for name, lines in self.lists.items():
            if lines:
                with open(os.path.join(self.folder, f"{name}.txt"), "w", encoding="utf-8") as file:
                    file.writelines(line + "\n" for line in lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bag", help=".bag file, or folder or .mcap file of ROS 2")
    parser.add_argument("out", help="folder to write; must not exist")
    parser.add_argument("--image", required=True, metavar="TOPIC", help="color images")
    parser.add_argument("--pose", required=True, metavar="TOPIC", help="poses of the camera, or of the body that carries it")
    parser.add_argument("--camera-info", required=True, metavar="TOPIC", help="lens of the color camera")
    parser.add_argument("--depth", metavar="TOPIC", help="depth images, aligned to the color images")
    parser.add_argument("--camera-in-body", nargs=7, type=float, default=[0, 0, 0, 0, 0, 0, 1], metavar="N",
                        help="pose of the camera in the frame of the body: x y z (meters) qx qy qz qw")
    args = parser.parse_args()
    try:
        from pathlib import Path

        import numpy  # noqa: F401
        import PIL  # noqa: F401
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        sys.exit(f"error: the Python package {error.name} is missing; install it: pip install rosbags numpy pillow")
    if os.path.exists(args.out):
        sys.exit(f"error: {args.out} exists; choose a new folder")
    kinds = {args.image: "image", args.pose: "pose", args.camera_info: "info", args.depth: "depth"}
    # The definitions of standard messages are needed for bags that do not contain them.
    with AnyReader([Path(args.bag)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        known = {connection.topic for connection in reader.connections}
        missing = [topic for topic in kinds if topic and topic not in known]
        if missing:
            sys.exit(f"error: the bag has no topic {', '.join(missing)}; it has {', '.join(sorted(known))}")
        writer = Writer(args.out, args.camera_in_body)
        wanted = [connection for connection in reader.connections if connection.topic in kinds]
        for connection, _, data in reader.messages(connections=wanted):
            writer.add(kinds[connection.topic], reader.deserialize(data, connection.msgtype))
    writer.finish()
    counts = {name: len(lines) for name, lines in writer.lists.items()}
    print(f"{args.out}: {counts['rgb']} images, {counts['depth']} depth images, {counts['groundtruth']} poses; "
          f"train with: fieldrig train {args.out}")


if __name__ == "__main__":
    main()

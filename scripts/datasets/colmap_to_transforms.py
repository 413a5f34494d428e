#!/usr/bin/env python3
"""Converts a COLMAP model in text form to a transforms.json, which `fieldrig train` reads. Needs only Python.

    colmap model_converter --input_path sparse/0 --output_path sparse/0 --output_type TXT
    scripts/datasets/colmap_to_transforms.py sparse/0 images --meters-per-unit 0.37

Poses that COLMAP has estimated from photos have an arbitrary scale. To find it, measure a distance in the scene, and
divide it by the same distance in the model. Formats: https://colmap.github.io/format.html.
"""

import argparse
import json
import math
import os
import sys

# Names of the parameters of each camera model of COLMAP, as transforms.json spells them. "f" is used along both axes.
LENSES = {
    "SIMPLE_PINHOLE": ["f", "cx", "cy"],
    "PINHOLE": ["fl_x", "fl_y", "cx", "cy"],
    "SIMPLE_RADIAL": ["f", "cx", "cy", "k1"],
    "RADIAL": ["f", "cx", "cy", "k1", "k2"],
    "OPENCV": ["fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"],
    "OPENCV_FISHEYE": ["fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"],
}


def lines_of(model, name):
    """The lines of a file of the model, without comments. Lines may be empty: an image may have no features."""
    path = os.path.join(model, name)
    if not os.path.exists(path):
        has_binary = os.path.exists(path[: -len("txt")] + "bin")
        remedy = f"convert the model to text: colmap model_converter --input_path {model} --output_path {model} --output_type TXT"
        sys.exit(f"error: {path} does not exist; {remedy if has_binary else 'pass the folder with the files of the model'}")
    with open(path, encoding="utf-8") as file:
        return [line.strip() for line in file if not line.startswith("#")]


def lens(line):
    """Id and lens of a line of cameras.txt. As in transforms.json, the center of the first pixel is (0.5, 0.5)."""
    camera, model, width, height, *parameters = line.split()
    if model not in LENSES:
        sys.exit(
            f"error: camera {camera} has the model {model}, expected {', '.join(LENSES)}: "
            "undistort the images with colmap image_undistorter"
        )
    values = dict(zip(LENSES[model], map(float, parameters), strict=True))
    if "f" in values:
        values["fl_x"] = values["fl_y"] = values.pop("f")
    return camera, {"camera_model": model, "w": int(width), "h": int(height), **values}


def rotation(w, x, y, z):
    """The rotation matrix of a quaternion."""
    length = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = (value / length for value in (w, x, y, z))
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def pose(quaternion, translation, meters_per_unit):
    """The pose of a camera with x right, y up, looking along -z, from COLMAP's camera_from_world with y down."""
    camera_from_world = rotation(*quaternion)
    center = [-sum(camera_from_world[k][row] * translation[k] for k in range(3)) for row in range(3)]
    signs = [1, -1, -1]
    rows = [
        [signs[column] * camera_from_world[column][row] for column in range(3)] + [center[row] * meters_per_unit]
        for row in range(3)
    ]
    return rows + [[0, 0, 0, 1]]


def write_points(model, path, meters_per_unit):
    """Writes the points of the model as a PLY file, and returns their number."""
    points = [line.split()[1:7] for line in lines_of(model, "points3D.txt") if line]
    names = ["float x", "float y", "float z", "uchar red", "uchar green", "uchar blue"]
    with open(path, "w", encoding="ascii") as file:
        file.write(f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n")
        file.writelines(f"property {name}\n" for name in names)
        file.write("end_header\n")
        for point in points:
            position = [str(float(value) * meters_per_unit) for value in point[:3]]
            file.write(" ".join(position + point[3:]) + "\n")
    return len(points)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", help="folder with cameras.txt, images.txt and points3D.txt")
    parser.add_argument("images", help="folder of the images; transforms.json is written beside it")
    parser.add_argument("--meters-per-unit", type=float, required=True, help="length of a unit of the model, meters")
    args = parser.parse_args()
    if not 0 < args.meters_per_unit < math.inf:
        sys.exit(f"error: --meters-per-unit is {args.meters_per_unit}, expected a number above 0")
    folder = os.path.dirname(os.path.abspath(args.images))
    lenses = dict(lens(line) for line in lines_of(args.model, "cameras.txt") if line)
    frames = []
    # Each image has two lines. The second one lists its features.
    for line in lines_of(args.model, "images.txt")[::2]:
        if not line:
            continue
        _, *numbers, camera, name = line.split(maxsplit=9)
        numbers = [float(number) for number in numbers]
        frames.append(
            {
                "file_path": os.path.relpath(os.path.join(args.images, name), folder),
                "transform_matrix": pose(numbers[:4], numbers[4:], args.meters_per_unit),
                **lenses[camera],
            }
        )
    path = os.path.join(folder, "transforms.json")
    if os.path.exists(path):
        sys.exit(f"error: {path} exists; move it away first")
    n_points = write_points(args.model, os.path.join(folder, "points.ply"), args.meters_per_unit)
    with open(path, "w", encoding="utf-8") as file:
        json.dump({"ply_file_path": "points.ply", "frames": frames}, file, indent=1)
    print(f"{path}: {len(frames)} images, {n_points} points; train with: fieldrig train {folder}")


if __name__ == "__main__":
    main()

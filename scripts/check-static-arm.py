#!/usr/bin/env python3
"""Checks whether a model of the simulated static arm reproduces details.

usage: check-static-arm.py FIELDRIG MODEL NERFSTUDIO_FOLDER   (NERFSTUDIO_FOLDER: from `fieldrig export REC.mcap --to nerfstudio`)

Renders every test view and prints one JSON object with
- tags: number of tag36h11 codes that OpenCV detects in the test images, in the renders, and in both;
- edges: position errors of the wooden block's silhouette edges in rendered depth, millimeters. The edge is where depth
  crosses half of its jump; the error is measured across the edge, in the plane of the adjacent face;
- ideal: the same for exact depth at the same pixels, which shows the error of the measurement.

Needs numpy and OpenCV with its aruco module. Geometry: sim/src/objects.rs.
"""

import json
import pathlib
import subprocess
import sys
import tempfile

import cv2
import numpy as np

TARGET_XY, TABLE_Z = None, None  # Set in `main`.
BLOCK_HALF = np.array([0.045, 0.02, 0.025])
BLOCK_IN_TARGET, BLOCK_YAW = np.array([-0.045, -0.058]), np.radians(-35.0)
STEP_M, REACH_M, ALONG_M, MIN_JUMP_M = 0.00025, 0.008, 0.003, 0.01


def layout(sources):
    """Position of the target and height of the table, parsed from the simulator's source to avoid a copy."""
    import re

    text = (sources / "sim/src/objects.rs").read_text()
    xy = re.search(r"TARGET_XY_M: \[f64; 2\] = \[([-\d.]+), ([-\d.]+)\]", text)
    z = re.search(r"TABLE_Z_M: f64 = ([-\d.]+)", text)
    return np.array([float(xy[1]), float(xy[2])]), float(z[1])


def world_from_block():
    c, s = np.cos(BLOCK_YAW), np.sin(BLOCK_YAW)
    pose = np.eye(4)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:3, 3] = [*(TARGET_XY + BLOCK_IN_TARGET), TABLE_Z + BLOCK_HALF[2]]
    return pose


def exact_depth(camera, world_from_camera, px):
    """Depth along z of the block or table at pixels [n, 2]."""
    rays = np.c_[(px - camera["c"]) / camera["f"], np.ones(len(px))] @ world_from_camera[:3, :3].T
    eye = world_from_camera[:3, 3]
    table = (TABLE_Z - eye[2]) / rays[:, 2]
    block = world_from_block()
    local_rays, local_eye = rays @ block[:3, :3], (eye - block[:3, 3]) @ block[:3, :3]
    with np.errstate(divide="ignore"):
        t = (np.array([-1.0, 1.0])[:, None, None] * BLOCK_HALF - local_eye) / local_rays
    enter, leave = t.min(0).max(1), t.max(0).min(1)
    return np.where((enter < leave) & (enter > 0), enter, np.where(table > 0, table, np.inf))


def sample(depth, px):
    """Bilinear interpolation; pixel centers at + 0.5, NaN outside."""
    at = px - 0.5
    x, y = np.floor(at).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x + 1 < depth.shape[1]) & (y + 1 < depth.shape[0])
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    fx, fy = (at - np.floor(at)).T
    mixed = (depth[y, x] * (1 - fx) + depth[y, x + 1] * fx) * (1 - fy) + (depth[y + 1, x] * (1 - fx) + depth[y + 1, x + 1] * fx) * fy
    return np.where(inside, mixed, np.nan)


def edge_errors(depth, camera, world_from_camera):
    """Signed distance of each sampled silhouette point from the true edge, meters, outward positive."""
    camera_from_world = np.linalg.inv(world_from_camera)
    block = world_from_block()
    eye = (np.linalg.inv(block) @ world_from_camera)[:3, 3]
    offsets = np.arange(-REACH_M, REACH_M + STEP_M / 2, STEP_M)
    errors = []
    for axis in range(3):
        for sign in (-1, 1):
            if sign * eye[axis] <= BLOCK_HALF[axis]:
                continue  # The face points away.
            for outward in (a for a in range(3) if a != axis):
                for side in (-1, 1):
                    hidden = side * eye[outward] < BLOCK_HALF[outward]
                    along = 3 - axis - outward
                    if not hidden or (along != 2 and outward == 2 and side < 0):
                        continue  # No silhouette, or block and table touch here.
                    for place in np.arange(-BLOCK_HALF[along] + 0.006, BLOCK_HALF[along] - 0.006, ALONG_M):
                        points = np.zeros((len(offsets), 3))
                        points[:, axis] = sign * BLOCK_HALF[axis]
                        points[:, outward] = side * (BLOCK_HALF[outward] + offsets)
                        points[:, along] = place
                        world = points @ block[:3, :3].T + block[:3, 3]
                        in_camera = world @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
                        if (in_camera[:, 2] <= 0).any():
                            continue
                        px = in_camera[:, :2] / in_camera[:, 2:] * camera["f"] + camera["c"]
                        found, plane = sample(depth, px), in_camera[:, 2]
                        if np.isnan(found).any() or abs(found[0] - plane[0]) > 0.01 or found[-1] - plane[-1] < MIN_JUMP_M:
                            continue  # Outside the image, occluded, or no depth jump.
                        is_beyond_edge = found - plane > 0.5 * (found[-1] - plane[-1])
                        first = int(np.argmax(is_beyond_edge))
                        errors.append(offsets[first] - STEP_M / 2)
    return errors


def summarize(errors):
    size = np.abs(np.array(errors)) * 1e3
    if not len(size):
        return {"n": 0}
    return {"n": len(size), "bias_mm": round(float(np.mean(errors)) * 1e3, 3), "median_mm": round(float(np.median(size)), 3),
            "p95_mm": round(float(np.percentile(size, 95)), 3), "within_2_mm": round(float((size <= 2.0).mean()), 4)}


def main():
    global TARGET_XY, TABLE_Z
    fieldrig, model, folder = sys.argv[1:4]
    TARGET_XY, TABLE_Z = layout(pathlib.Path(__file__).resolve().parent.parent)
    folder = pathlib.Path(folder)
    transforms = json.loads((folder / "transforms.json").read_text())
    frames = [f for f in transforms["frames"] if f["file_path"] in set(transforms["test_filenames"])]
    first = {**transforms, **frames[0]}  # Values that all frames share are at the top level.
    height, width = int(first["h"]), int(first["w"])
    fov = 2 * np.degrees(np.arctan(height / 2 / first["fl_y"]))
    path = {"render_height": height, "render_width": width, "camera_path": [
        {"camera_to_world": [x for row in f["transform_matrix"] for x in row], "fov": fov} for f in frames]}
    with tempfile.TemporaryDirectory() as out:
        out = pathlib.Path(out)
        (out / "path.json").write_text(json.dumps(path))
        subprocess.run([fieldrig, "render", model, "--camera-path", out / "path.json", "--depth", "--out", out / "pictures"], check=True)
        pictures, depths = sorted((out / "pictures").glob("*.png")), sorted((out / "pictures").glob("*.npy"))
        camera = {"f": np.array([first["fl_y"]] * 2), "c": np.array([width / 2, height / 2])}
        detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))

        def tags(image):
            ids = detector.detectMarkers(cv2.imread(str(image), cv2.IMREAD_GRAYSCALE))[1]
            return set() if ids is None else {int(i) for i in ids.ravel()}

        in_truth = in_render = in_both = 0
        missed, errors, ideal = [], [], []
        grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2)
        for frame, picture, depth in zip(frames, pictures, depths, strict=True):
            real, ours = tags(folder / frame["file_path"]), tags(picture)
            in_truth, in_render, in_both = in_truth + len(real), in_render + len(ours), in_both + len(real & ours)
            missed += [[frame["file_path"], i] for i in sorted(real - ours)]
            pose = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
            errors += edge_errors(np.load(depth).reshape(height, width), camera, pose)
            ideal += edge_errors(exact_depth(camera, pose, grid).reshape(height, width), camera, pose)
    print(json.dumps({"views": len(frames), "tags": {"in_truth": in_truth, "in_renders": in_render, "in_both": in_both, "missed": missed},
                      "edges": summarize(errors), "ideal": summarize(ideal)}))


if __name__ == "__main__":
    main()

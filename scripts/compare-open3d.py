#!/usr/bin/env python3
"""Compares a fieldrig distance field with Open3D's VoxelBlockGrid on the same images.

usage: compare-open3d.py surfaces DATA MODEL OUT_FOLDER   (MODEL: the folder of `fieldrig train DATA --method tsdf --refine none`)
       compare-open3d.py frame                            (compare with `cargo bench -p trainer --bench tsdf`)

`surfaces` fuses on the CPU the images of a nerfstudio folder that MODEL/keyframes.txt lists. Poses and lens are the same as for fieldrig;
depth range, voxel size and truncation are from MODEL/model.json. The script compares Open3D's mesh with MODEL/mesh.ply:
- fusing: milliseconds per image with color, the median after the first pass over all images, excluding image decoding;
- mesh: triangles, area, boundary edges (number, length and loops) and connected components of the mesh of all observed voxels.
  `mesh_default_threshold` uses voxels observed more than three times, Open3D's default. Vertices closer than 10 um are merged first,
  because neither program guarantees that blocks share vertices;
- against_depth: depth rendered from the mesh, compared with measured depth of test images, which neither program has fused: fraction of
  measured pixels with a surface, fraction with a surface within two voxels along z, and median error;
- distances of uniform samples on each mesh from the other mesh;
- renders of both meshes next to the photo, from the poses of test images, in OUT_FOLDER.

`frame` fuses the exact images of fieldrig's benchmark `tsdf` with voxels of 1 cm, for two block sizes and two number formats. It fuses
8 images, then times 4 more, then times all 12 again.

Prints one JSON object. Needs open3d 0.20 (pip), numpy, scipy, pillow. To limit both programs to the same cores, run both with
`taskset -c 0,1`, and this script also with OMP_NUM_THREADS=2.
"""

import argparse
import json
import pathlib
import statistics
import time

import numpy as np
import open3d as o3d
import open3d.core as o3c
from PIL import Image
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

CPU = o3c.Device("CPU:0")
# fieldrig's truncation for exact depth, in voxels.
TRUNCATION_VOXELS = 4.0
# fieldrig's vertices have f32 coordinates of a few meters. Vertices of neighboring blocks at the
# same position differ by less than this.
WELD_M = 1e-5
N_SAMPLES = 400_000
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


class Frame:
    """Depth in meters, color, lens and camera pose. Pixel centers are at + 0.5, as in fieldrig's files."""

    def __init__(self, name, depth_m, rgb, focal, principal, world_from_camera):
        self.name, self.depth_m, self.rgb = name, depth_m, rgb
        self.focal, self.principal, self.world_from_camera = focal, principal, world_from_camera
        self.depth_image = o3d.t.geometry.Image(o3c.Tensor(np.ascontiguousarray(depth_m, np.float32)))
        self.color_image = o3d.t.geometry.Image(o3c.Tensor(rgb.astype(np.float32) / 255.0))
        # In Open3D, pixel centers are at integers.
        lens = [[focal[0], 0, principal[0] - 0.5], [0, focal[1], principal[1] - 0.5], [0, 0, 1]]
        self.lens = o3c.Tensor(np.array(lens))
        self.camera_from_world = o3c.Tensor(np.linalg.inv(world_from_camera))


class Grid:
    """Open3D's distance field, fused as in Open3D's examples/python/t_reconstruction_system/integrate.py."""

    def __init__(self, voxel_m, truncation_voxels, depth_max_m, block=16, numbers=o3c.float32, n_blocks=40_000):
        self.truncation_voxels, self.depth_max_m = truncation_voxels, depth_max_m
        self.grid = o3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"), attr_dtypes=(o3c.float32, numbers, numbers),
            attr_channels=((1), (1), (3)), voxel_size=voxel_m, block_resolution=block, block_count=n_blocks, device=CPU)

    def fuse(self, frame):
        """Fuses a frame. Returns the milliseconds for finding blocks and for integration."""
        begin = time.perf_counter()
        blocks = self.grid.compute_unique_block_coordinates(
            frame.depth_image, frame.lens, frame.camera_from_world, 1.0, self.depth_max_m, self.truncation_voxels)
        found = time.perf_counter()
        self.grid.integrate(blocks, frame.depth_image, frame.color_image, frame.lens, frame.lens, frame.camera_from_world,
                            1.0, self.depth_max_m, self.truncation_voxels)
        return 1e3 * (found - begin), 1e3 * (time.perf_counter() - found)

    def mesh(self, min_weight):
        mesh = self.grid.extract_triangle_mesh(weight_threshold=min_weight)
        colors = mesh.vertex.colors.numpy() if "colors" in mesh.vertex else np.zeros((len(mesh.vertex.positions), 3))
        return Mesh(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy(), colors)


class Mesh:
    """Triangles in the world frame, meters; vertex colors from 0 to 1."""

    def __init__(self, places, triangles, colors):
        self.places, self.triangles, self.colors = places.astype(np.float64), triangles.astype(np.int64), colors
        self.scene = o3d.t.geometry.RaycastingScene(nthreads=2)
        self.scene.add_triangles(o3c.Tensor(self.places.astype(np.float32)), o3c.Tensor(self.triangles.astype(np.uint32)))

    @staticmethod
    def read(path):
        mesh = o3d.io.read_triangle_mesh(str(path))
        return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles), np.asarray(mesh.vertex_colors))

    def summary(self):
        _, first, one = np.unique(np.round(self.places / WELD_M).astype(np.int64), axis=0, return_index=True, return_inverse=True)
        places, triangles = self.places[first], one.reshape(-1)[self.triangles]
        degenerate = (triangles[:, 0] == triangles[:, 1]) | (triangles[:, 1] == triangles[:, 2]) | (triangles[:, 2] == triangles[:, 0])
        triangles = triangles[~degenerate]
        sides = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
        edges, n_uses = np.unique(sides, axis=0, return_counts=True)
        border = edges[n_uses == 1]
        n_parts, part_of = parts(triangles[:, [0, 0]], triangles[:, 1:], len(places))
        area_of_part = np.bincount(part_of[triangles[:, 0]], weights=area_of(places, triangles), minlength=n_parts)
        used = np.unique(part_of[triangles[:, 0]])
        n_loops, loop_of = parts(border[:, :1], border[:, 1:], len(places))
        return {
            "triangles": len(self.triangles), "area_m2": round(float(area_of(self.places, self.triangles).sum()), 3),
            "boundary_edges": len(border),
            "boundary_m": round(float(np.linalg.norm(places[border[:, 0]] - places[border[:, 1]], axis=1).sum()), 2),
            "boundary_loops": len(np.unique(loop_of[border[:, 0]])) if len(border) else 0,
            "edges_of_more_than_two": int((n_uses > 2).sum()),
            "parts": len(used), "parts_over_1_dm2": int((area_of_part > 0.01).sum()),
            "largest_part_frac": round(float(area_of_part.max() / area_of_part.sum()), 4),
        }

    def samples(self, n, seed):
        """Uniform samples on the surface."""
        random = np.random.default_rng(seed)
        areas = area_of(self.places, self.triangles)
        chosen = self.triangles[random.choice(len(areas), n, p=areas / areas.sum())]
        u, v = random.random((2, n, 1))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        a, b, c = (self.places[chosen[:, corner]] for corner in range(3))
        return a + u * (b - a) + v * (c - a)

    def render(self, frame):
        """Depth along z (0 where no surface is hit) and color of each pixel."""
        height, width = frame.depth_m.shape
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        in_camera = np.stack([(x - frame.principal[0]) / frame.focal[0], (y - frame.principal[1]) / frame.focal[1], np.ones_like(x)], -1)
        pose = frame.world_from_camera
        rays = np.concatenate([np.broadcast_to(pose[:3, 3], in_camera.shape), in_camera @ pose[:3, :3].T], -1)
        hits = self.scene.cast_rays(o3c.Tensor(rays.astype(np.float32)), nthreads=2)
        depth_m = hits["t_hit"].numpy()
        hit = np.isfinite(depth_m)
        corners = self.triangles[np.where(hit, hits["primitive_ids"].numpy(), 0).astype(np.int64)]
        uv = hits["primitive_uvs"].numpy()
        shares = np.stack([1 - uv.sum(-1), uv[..., 0], uv[..., 1]], -1)[..., None]
        rgb = np.where(hit[..., None], (self.colors[corners] * shares).sum(-2), 1.0)
        return np.where(hit, depth_m, 0.0), np.clip(255 * rgb + 0.5, 0, 255).astype(np.uint8)


def area_of(places, triangles):
    a, b, c = (places[triangles[:, corner]] for corner in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def parts(begins, ends, n):
    """Connected components of a graph of n points, and the component of each point."""
    begins, ends = begins.reshape(-1), ends.reshape(-1)
    return connected_components(coo_matrix((np.ones(len(begins)), (begins, ends)), (n, n)), directed=False)


def distances(one, other, voxel_m):
    """Distances from samples of one mesh to the other."""
    points = one.samples(N_SAMPLES, 1).astype(np.float32)
    away = other.scene.compute_distance(o3c.Tensor(points), nthreads=2).numpy()
    return {"mean_mm": round(1e3 * float(away.mean()), 2), "median_mm": round(1e3 * float(np.median(away)), 2),
            "within_1_voxel": round(float((away <= voxel_m).mean()), 4),
            "within_2_voxels": round(float((away <= 2 * voxel_m).mean()), 4)}


def against_depth(mesh, frames, voxel_m, depth_max_m):
    n_measured = n_hit = n_near = 0
    errors = []
    for frame in frames:
        depth_m, _ = mesh.render(frame)
        measured = (frame.depth_m > 0) & (frame.depth_m <= depth_max_m)
        hit = measured & (depth_m > 0)
        error = np.abs(depth_m[hit] - frame.depth_m[hit])
        n_measured, n_hit, n_near = n_measured + int(measured.sum()), n_hit + int(hit.sum()), n_near + int((error <= 2 * voxel_m).sum())
        errors.append(error)
    return {"frames": len(frames), "with_surface_frac": round(n_hit / n_measured, 4), "within_2_voxels_frac": round(n_near / n_measured, 4),
            "median_error_mm": round(1e3 * float(np.median(np.concatenate(errors))), 2)}


def frames_of(data, keyframes):
    """Training and test frames that the list names. Its stamps are indices: photo n, in order of names, has the stamp n ms."""
    summary = json.loads((data / "transforms.json").read_text())
    existing = sorted((f for f in summary["frames"] if (data / f["file_path"]).exists()), key=lambda f: f["file_path"])
    by_split = {"train": [], "validation": [], "test": []}
    for line in keyframes.read_text().splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        _, stamp, split = line.split()
        frame = {**summary, **existing[int(stamp) // 1_000_000]}
        unit = summary.get("depth_unit_scale_factor", 0.001)
        depth_m = np.asarray(Image.open(data / frame["depth_file_path"])).astype(np.float32) * np.float32(unit)
        rgb = np.asarray(Image.open(data / frame["file_path"]).convert("RGB"))
        pose = np.array(frame["transform_matrix"]) @ OPENGL
        by_split[split].append(
            Frame(frame["file_path"], depth_m, rgb, [frame["fl_x"], frame["fl_y"]], [frame["cx"], frame["cy"]], pose))
    return by_split["train"] + by_split["validation"], by_split["test"]


def timing(millis):
    find, integrate = zip(*millis)
    return {"frames": len(millis), "median_millis": round(statistics.median(map(sum, millis)), 2),
            "find_blocks_millis": round(statistics.median(find), 2), "integrate_millis": round(statistics.median(integrate), 2)}


def surfaces(args):
    lattice = json.loads((args.model / "model.json").read_text())["lattice"]
    voxel_m, depth_max_m = lattice["voxel_m"], lattice["max_depth_m"]
    truncation_voxels = lattice["truncation_m"] / voxel_m
    frames, test_frames = frames_of(args.data, args.model / "keyframes.txt")
    summary = {"open3d": {"version": o3d.__version__}}
    for block in (8, 16):
        grid = Grid(voxel_m, truncation_voxels, depth_max_m, block)
        for frame in frames:
            grid.fuse(frame)
        theirs = grid.mesh(0.0)
        summary["open3d"]["mesh"], summary["open3d"]["mesh_default_threshold"] = theirs.summary(), grid.mesh(3.0).summary()
        summary["open3d"][f"fusing_blocks_of_{block}"] = timing([grid.fuse(frame) for frame in frames])  # All blocks are allocated already.
    ours = Mesh.read(args.model / "mesh.ply")
    summary["fieldrig"] = {"mesh": ours.summary()}
    summary["voxel_mm"], summary["truncation_voxels"], summary["frames"] = 1e3 * voxel_m, truncation_voxels, len(frames)
    for name, mesh in (("open3d", theirs), ("fieldrig", ours)):
        summary[name]["against_depth"] = against_depth(mesh, test_frames, voxel_m, depth_max_m)
    summary["from_fieldrig_to_open3d"] = distances(ours, theirs, voxel_m)
    summary["from_open3d_to_fieldrig"] = distances(theirs, ours, voxel_m)
    args.out.mkdir(parents=True, exist_ok=True)
    for frame in test_frames:
        row = [frame.rgb, ours.render(frame)[1], theirs.render(frame)[1]]
        Image.fromarray(np.concatenate(row, 1)).save(args.out / f"{pathlib.Path(frame.name).stem}.png")
    return summary


def exact_frame(ix):
    """Frame `ix` of the benchmark `tsdf`: exact depth and color of a ball on a floor in front of a wall."""
    turn = 0.02 * ix - 1.57
    eye, target = np.array([1.6 * np.cos(turn), 1.6 * np.sin(turn), 0.9]), np.array([0.0, 0.3, 0.3])
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(ahead, right), ahead], 1), eye
    focal, principal = [525.0, 525.0], [320.0, 240.0]
    x, y = np.meshgrid(np.arange(640) + 0.5, np.arange(480) + 0.5)
    rays = np.stack([(x - principal[0]) / focal[0], (y - principal[1]) / focal[1], np.ones_like(x)], -1) @ pose[:3, :3].T
    depths = []
    for normal, offset in (([0.0, 0.0, 1.0], 0.0), ([0.0, -1.0, 0.0], -1.5)):
        with np.errstate(divide="ignore"):
            depths.append((offset - eye @ normal) / (rays @ normal))
    center = eye - [0.0, 0.0, 0.3]
    a, b = (rays * rays).sum(-1), rays @ center
    root = b * b - a * (center @ center - 0.3**2)
    depths.append(np.where(root >= 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf))
    depth_m = np.min([np.where(depth > 0, depth, np.inf) for depth in depths], axis=0)
    depth_m = np.where(np.isfinite(depth_m), depth_m, 0.0)
    points = eye + rays * depth_m[..., None]
    rgb = np.round(255 * (0.5 + 0.4 * np.sin(3.0 * points + np.arange(3.0))))
    return Frame(f"frame {ix}", depth_m, np.where(depth_m[..., None] > 0, rgb, 0).astype(np.uint8), focal, principal, pose)


def frame(_args):
    frames = [exact_frame(ix) for ix in range(12)]
    summary = {"open3d": o3d.__version__, "voxel_mm": 10, "truncation_voxels": TRUNCATION_VOXELS}
    for block, numbers, name in ((16, o3c.float32, "blocks_of_16_f32"), (16, o3c.uint16, "blocks_of_16_u16"), (8, o3c.float32, "blocks_of_8_f32"), (8, o3c.uint16, "blocks_of_8_u16")):
        grid = Grid(0.01, TRUNCATION_VOXELS, 10.0, block, numbers)
        for each in frames[:8]:
            grid.fuse(each)
        summary[name] = {"new": timing([grid.fuse(each) for each in frames[8:]]), "again": timing([grid.fuse(each) for each in frames]),
                      "blocks": grid.grid.hashmap().size()}
    return summary


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    of_data = commands.add_parser("surfaces", help="compare both meshes of the same images")
    of_data.add_argument("data", type=pathlib.Path, help="nerfstudio folder with depth")
    of_data.add_argument("model", type=pathlib.Path, help="output folder of `fieldrig train --method tsdf`")
    of_data.add_argument("out", type=pathlib.Path, help="folder for images")
    of_data.set_defaults(run=surfaces)
    commands.add_parser("frame", help="time the fusion of an exact image of 640x480").set_defaults(run=frame)
    args = parser.parse_args()
    print(json.dumps(args.run(args), indent=1))


if __name__ == "__main__":
    main()

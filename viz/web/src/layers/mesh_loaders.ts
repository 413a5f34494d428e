// Reads the mesh files of robots. This is a separate bundle, because it is large and many robots
// have no meshes. It returns plain data, because it contains a separate copy of three.js.

import { ColorManagement, type Material, Mesh, type Object3D } from "three";
import { ColladaLoader } from "three/examples/jsm/loaders/ColladaLoader.js";
import { OBJLoader } from "three/examples/jsm/loaders/OBJLoader.js";
import { STLLoader } from "three/examples/jsm/loaders/STLLoader.js";

export type MeshFormat = "stl" | "dae" | "obj";
/** Red, green and blue, 0 to 1; null if the file does not say. */
export type MeshColor = [number, number, number] | null;

/** A mesh of a file. */
export interface MeshPart {
  /** Pose and scale in the file, column-major. */
  fileFromPart: number[];
  /** Three coordinates per vertex. */
  positions: Float32Array;
  /** Three coordinates per vertex; null if the file has none. */
  normals: Float32Array | null;
  /** Vertices of the triangles; null if triangles share no vertices. */
  indices: Uint32Array | null;
  colors: MeshColor[];
  /** Ranges of vertices or indices with a color; empty if there is one color. */
  groups: { start: number; count: number; colorIx: number }[];
}

// Colors arrive as sRGB and are output unchanged.
ColorManagement.enabled = false;

/** All meshes of a file. */
export async function loadMeshes(url: string, format: MeshFormat): Promise<MeshPart[]> {
  const root = await load(url, format);
  root.updateMatrixWorld(true);
  const parts: MeshPart[] = [];
  root.traverse((object) => {
    if (object instanceof Mesh) parts.push(partOf(object, format));
  });
  return parts;
}

async function load(url: string, format: MeshFormat): Promise<Object3D> {
  if (format === "stl") return new Mesh(await new STLLoader().loadAsync(url));
  if (format === "obj") return new OBJLoader().loadAsync(url);
  const collada = await new ColladaLoader().loadAsync(url);
  if (!collada) throw new Error("not a COLLADA file");
  // The loader turns z-up files to y-up; URDF uses the file's axes.
  collada.scene.rotation.set(0, 0, 0);
  return collada.scene;
}

function partOf({ geometry, material, matrixWorld }: Mesh, format: MeshFormat): MeshPart {
  const { position, normal } = geometry.attributes;
  const materials = Array.isArray(material) ? material : [material];
  const groups = geometry.groups.map(({ start, count, materialIndex }) => ({ start, count, colorIx: materialIndex ?? 0 }));
  return {
    fileFromPart: matrixWorld.toArray(),
    positions: Float32Array.from(position!.array),
    normals: normal ? Float32Array.from(normal.array) : null,
    indices: geometry.index ? Uint32Array.from(geometry.index.array) : null,
    colors: materials.map((each) => (format === "dae" ? colorOf(each) : null)),
    groups: Array.isArray(material) ? groups : [],
  };
}

function colorOf(material: Material & { color?: { r: number; g: number; b: number } }): MeshColor {
  return material.color ? [material.color.r, material.color.g, material.color.b] : null;
}

// Draws a mesh that arrives in chunks.

import * as THREE from "three";
import { boxFromWorld, type Crop } from "../view/oriented_box";
import { type ObservationLayer, TINT } from "./observation_layer";
import { SOLID } from "./occlusion";
import type { MeshChunkHeader } from "../connection/protocol";
import { inflated } from "./zlib";

const BYTES_PER_VERTEX = 9;

export class MeshLayer {
  readonly root = new THREE.Group();
  /** Clipping planes of the crop box, and the plane in front of the eye. */
  private readonly planes: THREE.Plane[] = [new THREE.Plane(new THREE.Vector3(), 1)];
  private readonly near = this.planes[0]!;
  private readonly material: THREE.MeshBasicMaterial;
  private readonly chunks = new Map<number, THREE.Mesh>();

  constructor(observations: ObservationLayer) {
    // Like the server, draws surface colors without shading, and only the observed side.
    this.material = new THREE.MeshBasicMaterial({ vertexColors: true, clippingPlanes: this.planes });
    // The depth is increased by the tolerance of occlusion, so that objects on the surface are not hidden.
    const factor = `1.0 + ${SOLID.relative} - ${SOLID.meters} / mvPosition.z`;
    this.material.onBeforeCompile = (shader) => {
      Object.assign(shader.uniforms, observations.uniforms);
      shader.vertexShader = `varying vec3 pointInWorld;\n${shader.vertexShader}`.replace(
        "#include <project_vertex>",
        `#include <project_vertex>
  gl_Position = projectionMatrix * vec4(mvPosition.xyz * (${factor}), 1.0);
  pointInWorld = (modelMatrix * vec4(transformed, 1.0)).xyz;`,
      );
      shader.fragmentShader = `varying vec3 pointInWorld;\n${TINT}\n${shader.fragmentShader}`.replace(
        "#include <color_fragment>",
        "#include <color_fragment>\n  diffuseColor.rgb = tinted(diffuseColor.rgb, pointInWorld);",
      );
    };
  }

  /**
   * Decodes a chunk, then adds it or replaces its older version. `isCurrent` returns whether the
   * chunk is still wanted after decoding.
   */
  async set(header: MeshChunkHeader, payload: Uint8Array<ArrayBuffer>, isCurrent: () => boolean): Promise<void> {
    const geometry = await decodeMesh(header, payload);
    if (!isCurrent()) {
      geometry.dispose();
      return;
    }
    this.remove(header.id);
    const mesh = new THREE.Mesh(geometry, this.material);
    mesh.position.fromArray(header.origin_m);
    mesh.scale.setScalar(header.meters_per_count);
    this.chunks.set(header.id, mesh);
    this.root.add(mesh);
  }

  remove(id: number): void {
    const mesh = this.chunks.get(id);
    if (!mesh) return;
    mesh.geometry.dispose();
    this.root.remove(mesh);
    this.chunks.delete(id);
  }

  /** Frees all memory. The layer must not be drawn any more. */
  dispose(): void {
    for (const id of [...this.chunks.keys()]) this.remove(id);
    this.material.dispose();
  }

  /** The first observed side of a surface on a ray: its distance, at most `maxM`, and its normal. */
  hit(from: THREE.Vector3, direction: THREE.Vector3, maxM: number): { distance: number; normal: THREE.Vector3 } | null {
    this.root.updateMatrixWorld();
    const hits = new THREE.Raycaster(from, direction, 0, maxM).intersectObjects(this.root.children, false);
    const hit = hits.find(({ point }) => this.planes.every((plane) => plane === this.near || plane.distanceToPoint(point) >= 0));
    if (!hit?.face) return null;
    return { distance: hit.distance, normal: hit.face.normal.clone().transformDirection(hit.object.matrixWorld) };
  }

  /** Draws only the part of the mesh in a box. */
  set crop(crop: Crop | undefined) {
    const planes = crop
      ? boxFromWorld(crop).flatMap((row, axis) => {
          // A row of the transform is the axis of the box, and the offset of coordinates along it.
          const along = new THREE.Vector3(row.x, row.y, row.z);
          return [
            new THREE.Plane(along, row.w - crop.min_m[axis]!),
            new THREE.Plane(along.clone().negate(), crop.max_m[axis]! - row.w),
          ];
        })
      : [];
    this.planes.splice(0, this.planes.length, this.near, ...planes);
  }

  /** Draws only parts at or beyond this depth in the view of a camera. The pose is in fieldrig's convention. */
  setView(worldFromCamera: THREE.Matrix4, nearM: number): void {
    const forward = new THREE.Vector3().setFromMatrixColumn(worldFromCamera, 2);
    const eye = new THREE.Vector3().setFromMatrixPosition(worldFromCamera);
    this.near.set(forward, -forward.dot(eye) - nearM);
  }
}

async function decodeMesh(header: MeshChunkHeader, payload: Uint8Array<ArrayBuffer>): Promise<THREE.BufferGeometry> {
  const { n_vertices: nVertices, n_triangles: nTriangles } = header;
  const hasShortIndices = nVertices <= 65_536;
  const nIndexBytes = 3 * nTriangles * (hasShortIndices ? 2 : 4);
  const nExpected = BYTES_PER_VERTEX * nVertices + nIndexBytes;
  const bytes = await inflated(payload, nExpected);
  if (bytes.length !== nExpected) throw new Error(`a mesh has ${bytes.length} bytes, not ${nExpected}`);
  const copy = (begin: number, end: number): ArrayBuffer => bytes.slice(begin, end).buffer;
  const positions = new Uint16Array(copy(0, 6 * nVertices));
  const colors = bytes.slice(6 * nVertices, 9 * nVertices);
  // Values are differences from the values of the previous vertex. Typed arrays wrap around like
  // the encoder.
  for (let ix = 3; ix < positions.length; ix++) positions[ix]! += positions[ix - 3]!;
  for (let ix = 3; ix < colors.length; ix++) colors[ix]! += colors[ix - 3]!;
  const indexBytes = copy(9 * nVertices, nExpected);
  const indices = hasShortIndices ? new Uint16Array(indexBytes) : new Uint32Array(indexBytes);
  for (let ix = 1; ix < indices.length; ix++) indices[ix]! += indices[ix - 1]!;
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  geometry.setAttribute("color", new THREE.BufferAttribute(colors, 3, true));
  geometry.setIndex(new THREE.BufferAttribute(indices, 1));
  geometry.computeBoundingSphere();
  return geometry;
}

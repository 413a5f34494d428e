// Draws the depth of splats, so that they hide objects behind them. The depth of a pixel is the
// mean depth of its splats, weighted like their colors, as on the server.

import * as THREE from "three";
import { SPLAT_FRAGMENT, SPLAT_VERTEX } from "./splat_shader";

/** Size relative to the view, as for depth from the server. */
const SCALE = 0.5;

export class SplatDepth {
  private target: THREE.WebGLRenderTarget | null = null;
  /** Whether the GPU can draw to the target; null before the first attempt. */
  private isPossible: boolean | null = null;
  readonly material: THREE.RawShaderMaterial;

  /** Draws with the uniforms of the material for colors. */
  constructor(colors: THREE.RawShaderMaterial) {
    this.material = colors.clone();
    this.material.uniforms = colors.uniforms;
    this.material.vertexShader = SPLAT_VERTEX;
    this.material.fragmentShader = SPLAT_FRAGMENT;
    this.material.defines = { WRITES_DEPTH: 1 };
  }

  /** Frees all memory. */
  dispose(): void {
    this.target?.dispose();
    this.material.dispose();
  }

  /** Checks again whether the GPU can draw, because a lost WebGL context could not draw. */
  contextRestored(): void {
    this.isPossible = null;
  }

  /**
   * Draws the splats of a mesh. The texture holds the sum of the weighted depths, meters, and of the weights. Returns
   * null if the GPU cannot draw to textures of floats.
   */
  draw(
    renderer: THREE.WebGLRenderer,
    mesh: THREE.Mesh<THREE.InstancedBufferGeometry, THREE.RawShaderMaterial>,
    camera: THREE.Camera,
    sizePx: [number, number],
  ): THREE.Texture | null {
    if (this.isPossible === false) return null;
    const [width, height] = sizePx.map((side) => Math.ceil(SCALE * side)) as [number, number];
    this.target ??= depthTarget(renderer);
    this.target.setSize(width, height);
    const colors = mesh.material;
    const clearColor = renderer.getClearColor(new THREE.Color());
    const clearAlpha = renderer.getClearAlpha();
    mesh.material = this.material;
    renderer.setRenderTarget(this.target);
    this.isPossible ??= isComplete(renderer.getContext());
    if (this.isPossible) {
      renderer.setClearColor(0, 0);
      renderer.clear();
      renderer.render(mesh, camera);
    }
    renderer.setRenderTarget(null);
    renderer.setClearColor(clearColor, clearAlpha);
    mesh.material = colors;
    return this.isPossible ? this.target.texture : null;
  }
}

/** Whether the GPU can draw to the bound framebuffer. */
function isComplete(gl: WebGLRenderingContext | WebGL2RenderingContext): boolean {
  return gl.checkFramebufferStatus(gl.FRAMEBUFFER) === gl.FRAMEBUFFER_COMPLETE;
}

/** A target with 32-bit floats if the GPU can blend them. 16-bit floats have an error of 0.05 % per splat. */
function depthTarget(renderer: THREE.WebGLRenderer): THREE.WebGLRenderTarget {
  const hasFloatBlend = renderer.extensions.has("EXT_color_buffer_float") && renderer.extensions.has("EXT_float_blend");
  return new THREE.WebGLRenderTarget(1, 1, {
    format: THREE.RGFormat,
    type: hasFloatBlend ? THREE.FloatType : THREE.HalfFloatType,
    magFilter: THREE.NearestFilter,
    minFilter: THREE.NearestFilter,
    depthBuffer: false,
  });
}

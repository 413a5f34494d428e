// The renderer of the view.

import * as THREE from "three";

/**
 * A renderer for a canvas. Where the browser has no GPU and draws on the processor, lines and edges are not smoothed,
 * because that takes several times as long.
 */
export function viewRenderer(canvas: HTMLCanvasElement): THREE.WebGLRenderer {
  const context = canvas.getContext("webgl2", { antialias: true, failIfMajorPerformanceCaveat: true });
  return new THREE.WebGLRenderer(context ? { canvas, context } : { canvas, antialias: false });
}

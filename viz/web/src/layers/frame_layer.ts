// Axes and names of frames: the links of the robot, and the cameras.

import * as THREE from "three";
import { element } from "../panels/element";
import { axes, type PosedFrame } from "./overlays";

/** Length of the axes, relative to the radius of the scene. */
const AXIS_LENGTH = 0.1;
/** Names keep this distance from each other, pixels. */
const NAME_HEIGHT_PX = 15;
const NAME_WIDTH_PX = 110;

/** Opacity while the pose is outdated. */
const OUTDATED_OPACITY = 0.35;

interface Frame {
  axes: THREE.LineSegments;
  name: HTMLElement;
}

export class FrameLayer {
  readonly root = new THREE.Group();
  private readonly frames = new Map<string, Frame>();
  private readonly names = element("frame-names");
  private axisLengthM = AXIS_LENGTH;

  constructor() {
    this.root.visible = false;
  }

  set enabled(enabled: boolean) {
    this.root.visible = enabled;
    this.names.hidden = !enabled;
  }

  get isVisible(): boolean {
    return this.root.visible;
  }

  /** Adapts the size of the axes to a scene of this radius, meters. */
  set radiusM(radiusM: number) {
    this.axisLengthM = AXIS_LENGTH * radiusM;
  }

  /** Draws these frames by name, and removes all others. Names are placed for this camera. */
  update(posed: Map<string, PosedFrame>, camera: THREE.PerspectiveCamera): void {
    // The size is read before styles change. Otherwise, the browser would compute the layout twice.
    const { clientWidth, clientHeight } = this.names;
    const scale = new THREE.Vector3().setScalar(this.axisLengthM);
    for (const [name, frame] of this.frames) if (!posed.has(name)) this.remove(name, frame);
    for (const [name, { worldFromFrame, isOutdated }] of posed) {
      const frame = this.frames.get(name) ?? this.add(name);
      frame.axes.matrix.copy(worldFromFrame).scale(scale);
      const opacity = isOutdated ? OUTDATED_OPACITY : 1;
      (frame.axes.material as THREE.LineBasicMaterial).opacity = opacity;
      frame.name.style.opacity = String(opacity);
    }
    this.placeNames(camera, clientWidth, clientHeight);
  }

  private add(name: string): Frame {
    const drawn = axes(1);
    drawn.matrixAutoUpdate = false;
    drawn.frustumCulled = false;
    // Frames lie inside bodies, so they are drawn without a depth test.
    Object.assign(drawn.material, { depthTest: false, transparent: true });
    drawn.renderOrder = 2;
    const label = document.createElement("span");
    label.textContent = name;
    this.root.add(drawn);
    this.names.append(label);
    const frame = { axes: drawn, name: label };
    this.frames.set(name, frame);
    return frame;
  }

  private remove(name: string, frame: Frame): void {
    frame.axes.geometry.dispose();
    (frame.axes.material as THREE.LineBasicMaterial).dispose();
    frame.axes.removeFromParent();
    frame.name.remove();
    this.frames.delete(name);
  }

  /** Places the visible names in a view of this size, in whole pixels. */
  private placeNames(camera: THREE.PerspectiveCamera, width: number, height: number): void {
    const visible: { name: HTMLElement; at: Pixel }[] = [];
    for (const { axes, name } of this.frames.values()) {
      const { x, y, z } = new THREE.Vector3().setFromMatrixPosition(axes.matrix).project(camera);
      // Points behind the viewer or outside of the view.
      name.hidden = !(Math.abs(x) <= 1 && Math.abs(y) <= 1 && Math.abs(z) <= 1);
      if (name.hidden) continue;
      visible.push({ name, at: [Math.round(0.5 * width * (1 + x)), Math.round(0.5 * height * (1 - y))] });
    }
    const placed = withoutOverlaps(visible.map(({ at }) => at));
    visible.forEach(({ name }, ix) => {
      const [x, y] = placed[ix]!;
      name.style.translate = `${x}px ${y}px`;
    });
  }
}

type Pixel = [number, number];

/** Moves places down that would cover earlier ones. Places are whole numbers, so that sums are exact. */
function withoutOverlaps(places: Pixel[]): Pixel[] {
  const placed: Pixel[] = [];
  for (const [x, top] of places) {
    let y = top;
    const covers = ([otherX, otherY]: Pixel): boolean =>
      Math.abs(otherX - x) < NAME_WIDTH_PX && Math.abs(otherY - y) < NAME_HEIGHT_PX;
    for (let other = placed.find(covers); other; other = placed.find(covers)) y = other[1] + NAME_HEIGHT_PX;
    placed.push([x, y]);
  }
  return placed;
}

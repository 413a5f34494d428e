// Axes and names of frames: the links of the robot, and the cameras.

import * as THREE from "three";
import { element } from "./element";
import { axes } from "./overlays";

/** Length of the axes, relative to the radius of the scene. */
const AXIS_LENGTH = 0.1;
/** Names keep this distance from each other, pixels. */
const NAME_HEIGHT_PX = 15;
const NAME_WIDTH_PX = 110;

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

  /** Draws these frames, each with its pose in the world, and removes all others. Names are placed for this camera. */
  update(posed: Map<string, THREE.Matrix4>, camera: THREE.PerspectiveCamera): void {
    for (const [name, frame] of this.frames) if (!posed.has(name)) this.remove(name, frame);
    for (const [name, worldFromFrame] of posed) {
      const frame = this.frames.get(name) ?? this.add(name);
      frame.axes.matrix.copy(worldFromFrame).scale(new THREE.Vector3().setScalar(this.axisLengthM));
    }
    this.placeNames(camera);
  }

  private add(name: string): Frame {
    const drawn = axes(1);
    drawn.matrixAutoUpdate = false;
    drawn.frustumCulled = false;
    // Frames lie inside bodies.
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
    frame.axes.removeFromParent();
    frame.name.remove();
    this.frames.delete(name);
  }

  /** Moves names down that would cover others. */
  private placeNames(camera: THREE.PerspectiveCamera): void {
    const { clientWidth, clientHeight } = this.names;
    const placed: [number, number][] = [];
    for (const frame of this.frames.values()) {
      const at = new THREE.Vector3().setFromMatrixPosition(frame.axes.matrix).project(camera);
      const x = 0.5 * clientWidth * (1 + at.x);
      let y = 0.5 * clientHeight * (1 - at.y);
      frame.name.hidden = at.z > 1; // Behind the viewer.
      if (frame.name.hidden) continue;
      const covers = ([otherX, otherY]: [number, number]): boolean =>
        Math.abs(otherX - x) < NAME_WIDTH_PX && Math.abs(otherY - y) < NAME_HEIGHT_PX;
      for (let other = placed.find(covers); other; other = placed.find(covers)) y = other[1] + NAME_HEIGHT_PX;
      placed.push([x, y]);
      frame.name.style.translate = `${x.toFixed(1)}px ${y.toFixed(1)}px`;
    }
  }
}

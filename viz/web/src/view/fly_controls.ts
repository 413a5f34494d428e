// Flying: keys move the eye, and dragging turns the view. On touch screens, the left thumb moves
// the eye, and the right thumb turns the view.

import * as THREE from "three";
import { isKeptByFocus, isPageCovered } from "../keys";
import { element } from "../panels/element";
import { MOVEMENTS } from "./movement_keys";
import { uprightRotation } from "./up_axis";

/** Speed in radii of the scene per second, and the factor of the Shift key. */
const SPEED = 0.6;
const FAST = 4;
/** The speed approaches the speed that the keys request with this time constant. */
const SMOOTHING_SECS = 0.08;
/** Motions slower than this end. */
const MIN_SPEED = 1e-3;
/** Maximum time of one step. After a longer pause, the eye moves only as far as in this time. */
const MAX_STEP_SECS = 0.2;
/** A turn of the view per pixel, relative to the angle between two pixels. */
const LOOK_SCALE = 1.5;
const MAX_PITCH = 1.55;
/** Distance of the thumb from its first position at which the speed is full. */
const STICK_PX = 60;
/** Fraction of the scene's radius that a notch of the wheel moves. */
const WHEEL_FRAC = 0.06;
const NOTCH_PX = 100;

interface Touch {
  isStick: boolean;
  begin: THREE.Vector2;
  last: THREE.Vector2;
}

export class FlyControls {
  /** Radius of the scene, meters. */
  radiusM = 1;
  private isOn = false;
  private readonly keys = new Set<string>();
  private readonly touches = new Map<number, Touch>();
  /** Right, up and forward, radii per second. */
  private readonly velocity = new THREE.Vector3();
  private readonly stick = element("stick");
  private updatedAt = performance.now();

  constructor(
    private readonly camera: THREE.PerspectiveCamera,
    private readonly target: THREE.Vector3,
    private readonly canvas: HTMLCanvasElement,
    private readonly moved: () => void,
  ) {
    // This listener runs before the listener for the keys of buttons.
    window.addEventListener("keydown", (event) => this.press(event), { capture: true });
    window.addEventListener("keyup", (event) => this.keys.delete(event.code), { capture: true });
    window.addEventListener("blur", () => this.release());
    canvas.addEventListener("pointerdown", (event) => this.begin(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const kind of ["pointerup", "pointercancel"] as const) {
      canvas.addEventListener(kind, (event) => this.end(event));
    }
    canvas.addEventListener("wheel", (event) => this.roll(event), { passive: false });
  }

  get enabled(): boolean {
    return this.isOn;
  }

  set enabled(enabled: boolean) {
    this.isOn = enabled;
    this.release();
    this.velocity.set(0, 0, 0);
    element("fly-hint").hidden = !enabled;
  }

  /** Moves the eye; called for every display refresh. */
  update(): void {
    const now = performance.now();
    const secs = Math.min(MAX_STEP_SECS, (now - this.updatedAt) / 1000);
    this.updatedAt = now;
    if (!this.isOn) return;
    this.velocity.lerp(this.wanted(), 1 - Math.exp(-secs / SMOOTHING_SECS));
    if (this.velocity.length() < MIN_SPEED) this.velocity.set(0, 0, 0);
    else this.shift(this.velocity.clone().multiplyScalar(secs));
  }

  private wanted(): THREE.Vector3 {
    const wanted = new THREE.Vector3();
    for (const code of this.keys) wanted.add(new THREE.Vector3(...(MOVEMENTS[code] ?? [0, 0, 0])));
    if (wanted.length() > 1) wanted.normalize();
    for (const { isStick, begin, last } of this.touches.values()) {
      const along = last.clone().sub(begin).divideScalar(STICK_PX).clampLength(0, 1);
      if (isStick) wanted.add(new THREE.Vector3(along.x, 0, -along.y));
    }
    const isFast = this.keys.has("ShiftLeft") || this.keys.has("ShiftRight");
    return wanted.multiplyScalar(isFast ? SPEED * FAST : SPEED);
  }

  /** Moves to the right, up in the world, and forward, in radii of the scene. */
  private shift({ x, y, z }: THREE.Vector3): void {
    const right = new THREE.Vector3(1, 0, 0).applyQuaternion(this.camera.quaternion);
    const forward = this.camera.getWorldDirection(new THREE.Vector3());
    const motion = right.multiplyScalar(x).addScaledVector(this.camera.up, y).addScaledVector(forward, z);
    motion.multiplyScalar(this.radiusM);
    this.camera.position.add(motion);
    this.target.add(motion);
    this.moved();
  }

  /** Turns the view by a motion on the screen, pixels. */
  private look(x: number, y: number): void {
    const perPixel = (LOOK_SCALE * this.camera.fov * Math.PI) / 180 / this.canvas.clientHeight;
    const worldFromUpright = uprightRotation(this.camera.up);
    const forward = this.target.clone().sub(this.camera.position).applyQuaternion(worldFromUpright.clone().invert());
    const distance = forward.length();
    const yaw = Math.atan2(forward.y, forward.x) + x * perPixel;
    const pitch = Math.asin(THREE.MathUtils.clamp(forward.z / distance, -1, 1)) + y * perPixel;
    const [cosine, sine] = [Math.cos, Math.sin].map((f) => f(THREE.MathUtils.clamp(pitch, -MAX_PITCH, MAX_PITCH)));
    forward.set(cosine! * Math.cos(yaw), cosine! * Math.sin(yaw), sine!).applyQuaternion(worldFromUpright);
    this.target.copy(this.camera.position).addScaledVector(forward, distance);
    this.camera.lookAt(this.target);
    this.moved();
  }

  private press(event: KeyboardEvent): void {
    if (!this.isOn || isKeptByFocus(event) || isPageCovered() || event.ctrlKey || event.metaKey || event.altKey) return;
    this.keys.add(event.code);
    if (!(event.code in MOVEMENTS)) return;
    event.preventDefault();
    event.stopImmediatePropagation();
  }

  private release(): void {
    this.keys.clear();
    this.touches.clear();
    this.stick.hidden = true;
  }

  private begin(event: PointerEvent): void {
    if (!this.isOn) return;
    const at = new THREE.Vector2(event.offsetX, event.offsetY);
    const isStick = event.pointerType === "touch" && event.offsetX < 0.5 * this.canvas.clientWidth;
    this.touches.set(event.pointerId, { isStick, begin: at, last: at.clone() });
    this.canvas.setPointerCapture(event.pointerId);
    if (!isStick) return;
    this.stick.hidden = false;
    this.stick.style.left = `${event.offsetX}px`;
    this.stick.style.top = `${event.offsetY}px`;
  }

  private drag(event: PointerEvent): void {
    const touch = this.touches.get(event.pointerId);
    if (!touch) return;
    const at = new THREE.Vector2(event.offsetX, event.offsetY);
    // The scene follows the pointer.
    if (!touch.isStick) this.look(at.x - touch.last.x, at.y - touch.last.y);
    touch.last.copy(at);
  }

  private end(event: PointerEvent): void {
    if (this.touches.get(event.pointerId)?.isStick) this.stick.hidden = true;
    this.touches.delete(event.pointerId);
  }

  private roll(event: WheelEvent): void {
    if (!this.isOn) return;
    event.preventDefault();
    const notches = event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? event.deltaY / NOTCH_PX : Math.sign(event.deltaY);
    this.shift(new THREE.Vector3(0, 0, -WHEEL_FRAC * THREE.MathUtils.clamp(notches, -3, 3)));
  }
}

// The current camera images, as thumbnails in the corner or docked in the side panel. A click on a thumbnail enlarges it.

import { decodeJpeg, drawBitmap } from "../layers/jpeg";
import { element } from "./element";
import { child, make, setText } from "./html";
import { ageText } from "./quantities";
import type { LiveImageHeader } from "../connection/protocol";
import { markRidden, rideButton } from "./ride_button";
import type { Age, ServerClock } from "../connection/server_clock";
import { store, stored } from "./storage";

/** Images older than this are not labeled live. */
const LIVE_MILLIS = 500;
/** Images older than this are dimmed. */
const DIM_MILLIS = 2000;
/** Key under which the browser stores which cameras' images are in the side panel. */
const DOCKED_KEY = "docked-cameras";

interface Slot {
  figure: HTMLElement;
  canvas: HTMLCanvasElement;
  caption: HTMLElement;
  ageText: HTMLElement;
  dock: HTMLButtonElement;
  /** Age of the shown image. */
  age: Age;
  waiting: { jpeg: Uint8Array<ArrayBuffer>; age: Age } | null;
  isDecoding: boolean;
}

export class LiveImages {
  /** Cameras whose image has been enlarged, and whether it still is. */
  readonly resized = new Map<string, boolean>();
  /** Called when the user wants the view to ride on a camera, or to leave it. */
  ride: (camera: string) => void = () => undefined;
  private riddenCamera: string | null = null;
  private isEnabled = true;
  private hasDock = true;
  /** Cameras whose image the user has moved to the side panel. */
  private readonly docked = storedCameras();
  private readonly slots = new Map<string, Slot>();

  constructor(
    private readonly clock: () => ServerClock,
    private readonly onResize: () => void,
  ) {
    window.setInterval(() => this.showAges(), 100);
  }

  /** Shows an image, unless a newer one of its camera arrives before it is decoded. */
  show(header: LiveImageHeader, jpeg: Uint8Array<ArrayBuffer>): void {
    const slot = this.slots.get(header.camera) ?? this.add(header.camera);
    slot.waiting = { jpeg, age: this.clock().ageOf(header.captured_millis) };
    if (!slot.isDecoding) void this.decode(slot);
  }

  private async decode(slot: Slot): Promise<void> {
    slot.isDecoding = true;
    for (let next = slot.waiting; next; next = slot.waiting) {
      slot.waiting = null;
      try {
        drawBitmap(slot.canvas, await decodeJpeg(next.jpeg));
        slot.age = next.age;
      } catch {
        // The caption shows that the image is outdated.
      }
      this.showAges();
    }
    slot.isDecoding = false;
  }

  /** Removes all images, because another run may have other cameras. */
  clear(): void {
    this.reduce();
    for (const { figure } of this.slots.values()) figure.remove();
    this.slots.clear();
    this.showDock();
  }

  /** Whether the images are shown. */
  set enabled(enabled: boolean) {
    element("live").hidden = !enabled;
    this.isEnabled = enabled;
    this.showDock();
  }

  /** Whether images can be in the side panel. Otherwise, all of them are in the view. */
  set canDock(canDock: boolean) {
    if (canDock === this.hasDock) return;
    this.hasDock = canDock;
    for (const slot of this.slots.values()) this.place(slot);
  }

  /** Cameras whose images are in the side panel. */
  get dockedCameras(): string[] {
    return [...this.docked];
  }

  set dockedCameras(cameras: readonly string[]) {
    this.docked.clear();
    for (const camera of cameras) this.docked.add(camera);
    store(DOCKED_KEY, JSON.stringify(cameras));
    for (const slot of this.slots.values()) this.place(slot);
  }

  /** Moves an image to where it belongs, and describes its button. */
  private place({ figure, dock }: Slot): void {
    const isDocked = this.docked.has(figure.dataset.camera!);
    const parent = element(isDocked && this.hasDock ? "docked" : "live");
    dock.textContent = isDocked ? "⇤" : "⇥";
    dock.title = isDocked ? "Move this image to the view" : "Move this image to the side panel";
    dock.ariaLabel = `Move the image of ${figure.dataset.camera} to the ${isDocked ? "view" : "side panel"}`;
    const hadFocus = document.activeElement === dock;
    parent.append(figure);
    if (hadFocus) dock.focus();
    if (isDocked) this.setEnlarged(figure, false);
    this.showDock();
  }

  /** Whether an image is enlarged. */
  get isEnlarged(): boolean {
    return [...this.resized.values()].includes(true);
  }

  /** Returns all images to their first size. */
  reduce(): void {
    for (const { figure } of this.slots.values()) this.setEnlarged(figure, false);
  }

  private setEnlarged(figure: HTMLElement, isEnlarged: boolean): void {
    if (figure.classList.contains("enlarged") === isEnlarged) return;
    figure.classList.toggle("enlarged", isEnlarged);
    figure.querySelector("canvas")!.ariaExpanded = String(isEnlarged);
    this.resized.set(figure.dataset.camera!, isEnlarged);
    this.onResize();
  }

  /** The card in the side panel is visible if it contains images. */
  private showDock(): void {
    element("docked-card").hidden = !this.isEnabled || element("docked").childElementCount === 0;
  }

  private add(camera: string): Slot {
    const figure = make("figure");
    const canvas = make("canvas");
    const caption = make("figcaption");
    const ageText = make("span");
    const dock = make("button");
    caption.append(child("b", camera), ageText, dock, rideButton(camera, this.ridden === camera, () => this.ride(camera)));
    figure.append(canvas, caption);
    figure.dataset.camera = camera;
    figure.addEventListener("click", () => {
      if (!this.docked.has(camera)) this.setEnlarged(figure, !figure.classList.contains("enlarged"));
    });
    dock.addEventListener("click", (event) => {
      event.stopPropagation(); // It is not a click on the image.
      if (!this.docked.delete(camera)) this.docked.add(camera);
      store(DOCKED_KEY, JSON.stringify([...this.docked])); // Otherwise, it is docked until the page is reloaded.
      this.place(slot);
    });
    makeButton(canvas, `Enlarge the image of ${camera}`);
    const slot: Slot = { figure, canvas, caption, ageText, dock, age: () => null, waiting: null, isDecoding: false };
    this.place(slot);
    this.slots.set(camera, slot);
    return slot;
  }

  /** The camera that the view rides on; null if there is none. */
  get ridden(): string | null {
    return this.riddenCamera;
  }

  set ridden(ridden: string | null) {
    if (ridden === this.riddenCamera) return;
    this.riddenCamera = ridden;
    for (const [camera, { figure }] of this.slots) markRidden(figure, camera === ridden);
    // From now on, its images have a separate rate.
    if (ridden !== null && !this.resized.has(ridden)) this.resized.set(ridden, false);
    this.onResize();
  }

  private showAges(): void {
    for (const { figure, caption, ageText: label, age } of this.slots.values()) {
      const millis = age() ?? Infinity;
      caption.classList.toggle("stale", millis > LIVE_MILLIS);
      figure.classList.toggle("dimmed", millis > DIM_MILLIS);
      setText(label, millis > LIVE_MILLIS ? ageText(millis) : "live");
    }
  }
}

/**
 * Lets the keyboard click an element. This is the image and not its figure, because the figure
 * contains another button.
 */
function makeButton(target: HTMLElement, name: string): void {
  target.tabIndex = 0;
  target.role = "button";
  target.ariaLabel = name;
  target.addEventListener("keydown", (event) => {
    if (event.key !== "Enter" && event.key !== " ") return;
    event.preventDefault();
    target.click();
  });
}

function storedCameras(): Set<string> {
  try {
    const cameras: unknown = JSON.parse(stored(DOCKED_KEY) ?? "[]");
    return new Set(Array.isArray(cameras) ? cameras.filter((camera) => typeof camera === "string") : []);
  } catch {
    return new Set(); // It is no JSON.
  }
}

// What the cameras see now, as small pictures in the corner.

import { element } from "./element";
import type { LiveImageHeader } from "./protocol";

const STALE_MILLIS = 3000;

interface Slot {
  canvas: HTMLCanvasElement;
  caption: HTMLElement;
  age: HTMLElement;
  arrivedAt: number;
}

export class LiveImages {
  private readonly slots = new Map<string, Slot>();

  constructor() {
    window.setInterval(() => this.tellAges(), 500);
  }

  async show(header: LiveImageHeader, jpeg: Uint8Array<ArrayBuffer>): Promise<void> {
    const bitmap = await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }));
    const slot = this.slots.get(header.camera) ?? this.add(header.camera);
    slot.arrivedAt = performance.now();
    slot.canvas.width = bitmap.width;
    slot.canvas.height = bitmap.height;
    slot.canvas.getContext("2d")?.drawImage(bitmap, 0, 0);
    bitmap.close();
    this.tellAges();
  }

  private add(camera: string): Slot {
    const figure = document.createElement("figure");
    const canvas = document.createElement("canvas");
    const caption = document.createElement("figcaption");
    const name = document.createElement("b");
    const age = document.createElement("span");
    name.textContent = camera;
    caption.append(name, age);
    figure.append(canvas, caption);
    element("live").append(figure);
    const slot = { canvas, caption, age, arrivedAt: 0 };
    this.slots.set(camera, slot);
    return slot;
  }

  private tellAges(): void {
    for (const { caption, age, arrivedAt } of this.slots.values()) {
      const millis = performance.now() - arrivedAt;
      const isStale = millis > STALE_MILLIS;
      caption.classList.toggle("stale", isStale);
      age.textContent = isStale ? `${(millis / 1000).toFixed(0)} s old` : "live";
    }
  }
}

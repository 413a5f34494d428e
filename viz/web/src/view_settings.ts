// The panel with settings of the view: field of view, resolution, opacity, refresh, camera path.

import { CameraPath } from "./camera_path";
import { element } from "./element";
import type { OrbitView } from "./orbit_view";
import type { RenderScheduler } from "./render_scheduler";

export class ViewSettings {
  private readonly path = new CameraPath();
  private readonly fov = element("fov", HTMLInputElement);

  constructor(
    private readonly view: OrbitView,
    scheduler: RenderScheduler,
  ) {
    this.onInput("fov", (value) => (view.fovDegrees = value));
    this.onInput("opacity", (value) => {
      view.picture.opacity = value / 100;
      view.changed();
    });
    const width = element("picture-width", HTMLSelectElement);
    width.addEventListener("change", () => {
      view.maxPictureWidthPx = width.value === "window" ? Infinity : Number(width.value);
      scheduler.moved();
    });
    const refresh = element("refresh", HTMLSelectElement);
    refresh.addEventListener("change", () => (scheduler.isContinuous = refresh.value === "continuous"));
    element("path-add").addEventListener("click", () => this.edit(() => this.path.add(view.pathView())));
    element("path-clear").addEventListener("click", () => this.edit(() => this.path.clear()));
    element("path-play").addEventListener("click", () =>
      this.edit(() => (this.path.isPlaying ? this.path.stop() : this.path.play())),
    );
    element("path-save").addEventListener("click", () => this.save());
    // A user who takes over ends the playback.
    element("canvas").addEventListener("pointerdown", () => this.edit(() => this.path.stop()));
    this.edit(() => undefined);
  }

  /** Called for every display refresh. */
  tick(): void {
    const shown = this.path.current();
    if (!shown) return;
    this.view.showPathView(shown);
    this.edit(() => undefined);
  }

  private onInput(id: string, apply: (value: number) => void): void {
    const input = element(id, HTMLInputElement);
    input.addEventListener("input", () => {
      apply(input.valueAsNumber);
      element(`${id}-value`).textContent = input.value + (input.dataset.unit ?? "");
    });
  }

  /** Changes the path, and updates the panel. */
  private edit(change: () => void): void {
    change();
    const { nViews, isPlaying } = this.path;
    element("path-count").textContent = nViews === 1 ? "1 view" : `${nViews} views`;
    element("path-play").textContent = isPlaying ? "Stop" : "Play";
    for (const id of ["path-play", "path-save"]) element(id, HTMLButtonElement).disabled = nViews < 2;
    element("path-clear", HTMLButtonElement).disabled = nViews === 0;
    const fov = Math.round(this.view.pathView().fovDegrees);
    if (this.fov.valueAsNumber !== fov) {
      this.fov.value = String(fov);
      element("fov-value").textContent = `${fov}°`;
    }
  }

  private save(): void {
    const file = new Blob([this.path.file(this.view.view().size_px)], { type: "application/json" });
    const link = document.createElement("a");
    link.href = URL.createObjectURL(file);
    link.download = "camera_path.json";
    link.click();
    URL.revokeObjectURL(link.href);
  }
}

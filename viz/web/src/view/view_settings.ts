// The panel with settings of the view: field of view, resolution, opacity, refresh, camera path.

import { CameraPath, type PathView } from "./camera_path";
import { download } from "../panels/download";
import { element } from "../panels/element";
import type { OrbitView } from "./orbit_view";
import { PathVideo, whyNoVideo } from "./path_video";
import type { RenderScheduler } from "../connection/render_scheduler";
import { reasonOf } from "../panels/sentence";
import type { SideView } from "../layers/side_view";

export class ViewSettings {
  private readonly path = new CameraPath();
  private readonly fov = element("fov", HTMLInputElement);
  private readonly video: PathVideo;

  constructor(
    private readonly view: OrbitView,
    scheduler: RenderScheduler,
    side: SideView,
  ) {
    this.video = new PathVideo(side, (along, sizePx) => ({
      ...scheduler.picture(view.viewAlong(along, sizePx)),
      outputs: ["color"],
    }));
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
    element("path-video").addEventListener("click", () => {
      if (this.video.isRecording) this.video.cancel();
      else void this.record();
    });
    // The playback ends when the user moves the view.
    element("canvas").addEventListener("pointerdown", () => this.edit(() => this.path.stop()));
    this.edit(() => undefined);
  }

  /** Whether the view moves along the camera path. */
  get isPlaying(): boolean {
    return this.path.isPlaying;
  }

  /** The views of the camera path. */
  get pathViews(): readonly PathView[] {
    return this.path.all;
  }

  /** Replaces the camera path by the path of a link, if the link has one. Shows the field of view of the link. */
  restorePath(views: readonly PathView[]): void {
    this.edit(() => {
      if (views.length > 0) this.path.clear();
      for (const view of views) this.path.add(view);
    });
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
    if (!this.video.isRecording) element("path-count").textContent = nViews === 1 ? "1 view" : `${nViews} views`;
    element("path-play").textContent = isPlaying ? "Stop" : "Play";
    for (const id of ["path-play", "path-save"]) element(id, HTMLButtonElement).disabled = nViews < 2;
    element("path-video").textContent = this.video.isRecording ? "Cancel" : "Video";
    element("path-video", HTMLButtonElement).disabled = nViews < 2 && !this.video.isRecording;
    element("path-clear", HTMLButtonElement).disabled = nViews === 0;
    const fov = Math.round(this.view.attachment.fovDegrees); // Without the lens of a camera that the view rides on.
    if (this.fov.valueAsNumber !== fov) {
      this.fov.value = String(fov);
      element("fov-value").textContent = `${fov}°`;
    }
  }

  private save(): void {
    download(new Blob([this.path.file(this.view.view().size_px)], { type: "application/json" }), "camera_path.json");
  }

  private async record(): Promise<void> {
    const [note, count] = [element("path-note"), element("path-count")];
    const reason = whyNoVideo();
    note.textContent = reason ?? "";
    if (reason) return;
    const frames = this.path.frames();
    try {
      const recording = this.video.record(frames, this.view.view().size_px, (nDone) => {
        count.textContent = nDone < frames.length ? `picture ${nDone + 1} of ${frames.length}` : "writing";
      });
      this.edit(() => undefined);
      const file = await recording;
      if (file) download(file, "camera_path.mp4");
    } catch (error) {
      note.textContent = `Cannot record a video: ${reasonOf(error)}`;
    }
    this.edit(() => undefined);
  }
}

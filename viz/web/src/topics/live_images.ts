// The current images of the cameras, at the size at which they are shown.

import { element } from "../panels/element";
import type { PosedImage } from "../panels/keyframe_comparison";
import type { LiveImages } from "../panels/live_images";
import type { OrbitView } from "../view/orbit_view";
import type { LiveImageHeader, PosedCamera } from "../connection/protocol";
import { on, type Subscription, type Topic } from "./topic";

/** An image is labeled live for half a second. */
const HZ = 4;
/** The view moves with the poses of the camera that it rides on. */
const RIDDEN_HZ = 12;
/** Limits of the height of camera images, in CSS pixels: see `.live canvas` in styles/page.css. */
const IMAGE_HEIGHT = { min: 90, max: 190, ofWindow: 0.22 };
/** The same in a preview: see styles/preview.css. */
const ROOMY_HEIGHT = { min: 120, max: 420, ofWindow: 0.34 };
const MAX_IMAGE_WIDTH_PX = 640;
/** Maximum size of images that are enlarged or fill the view. */
const ENLARGED_PX: [number, number] = [1280, 960];
/** Maximum size of images that are compared with the model. */
const COMPARED_PX: [number, number] = [640, 640];
/** The pose of a camera is not current if the newest image of any camera is newer by this. */
const CURRENT_MILLIS = 5000;
/** The server rounds image sizes down to multiples of this. */
const IMAGE_STEP_PX = 16;

export class LiveImagesTopic implements Topic {
  readonly name = "live_images";
  /** The newest image with a pose. */
  latest: LiveImageHeader | null = null;
  private readonly posed = new Map<string, LiveImageHeader & PosedCamera>();
  readonly receivers = [
    on<LiveImageHeader>("live_image", (header, payload) => {
      this.images.show(header, payload);
      if (!header.world_from_camera) return;
      this.latest = header;
      element("look-live", HTMLButtonElement).disabled = false;
      const posed = { ...header, world_from_camera: header.world_from_camera };
      this.posed.set(header.camera, posed);
      if (header.camera === this.comparedCamera) this.onCompared({ header: posed, jpeg: payload });
      this.view.attachment.seen(posed);
      const hasMoved = this.view.overlays.setLiveCamera(posed, header.captured_millis);
      if (hasMoved) this.view.changed();
    }),
  ];
  /** Called with each image of the compared camera. */
  onCompared: (image: PosedImage) => void = () => undefined;
  private comparedCamera: string | null = null;
  private isShown = true;
  private isRoomy = false;
  private fillsView = false;

  constructor(
    private readonly view: OrbitView,
    private readonly images: LiveImages,
    private readonly changed: () => void,
  ) {}

  /** The newest images with poses, one of each camera. */
  get current(): (LiveImageHeader & PosedCamera)[] {
    const all = [...this.posed.values()];
    const newest = Math.max(...all.map(({ captured_millis }) => captured_millis));
    return all.filter(({ captured_millis }) => captured_millis > newest - CURRENT_MILLIS);
  }

  /** Whether camera images are shown. If not, small images are requested, because their poses are still needed. */
  set shown(shown: boolean) {
    this.images.enabled = shown;
    this.isShown = shown;
    this.changed();
  }

  /** Whether the camera images fill the view. */
  set large(fillsView: boolean) {
    this.images.canDock = !fillsView; // The side panel is hidden.
    this.fillsView = fillsView;
    this.changed();
  }

  /** Whether there is no model that larger images would hide. */
  set roomy(isRoomy: boolean) {
    this.isRoomy = isRoomy;
    this.changed();
  }

  /** The camera whose images are compared with the model. */
  set compared(camera: string | null) {
    if (camera === this.comparedCamera) return;
    this.comparedCamera = camera;
    // From now on, its images have a separate size.
    if (camera !== null && !this.images.resized.has(camera)) this.images.resized.set(camera, false);
    this.changed();
  }

  subscriptions(isHidden: boolean): Subscription[] {
    const cameras = [...this.images.resized];
    if (isHidden) return [{ rate_hz: 0 }, ...cameras.map(([camera]) => ({ camera, rate_hz: 0 }))];
    const sizePx = (isLarge: boolean): [number, number] => (isLarge || this.fillsView ? ENLARGED_PX : this.thumbnailPx());
    return [
      { rate_hz: HZ, size_px: sizePx(false) },
      ...cameras.map(([camera, isEnlarged]) => ({
        rate_hz: camera === this.images.ridden ? RIDDEN_HZ : HZ,
        camera,
        size_px: camera === this.comparedCamera ? COMPARED_PX : sizePx(isEnlarged && this.isShown),
      })),
    ];
  }

  restart(): void {
    this.latest = null;
    this.posed.clear();
    element("look-live", HTMLButtonElement).disabled = true;
    this.view.overlays.forgetLive();
    this.view.attachment.forgetCameras();
  }

  private thumbnailPx(): [number, number] {
    if (!this.isShown) return [IMAGE_STEP_PX, IMAGE_STEP_PX];
    const { min, max, ofWindow } = this.isRoomy ? ROOMY_HEIGHT : IMAGE_HEIGHT;
    const height = Math.min(max, Math.max(min, ofWindow * window.innerHeight)) * Math.min(devicePixelRatio, 2);
    return [this.isRoomy ? ENLARGED_PX[0] : MAX_IMAGE_WIDTH_PX, IMAGE_STEP_PX * Math.ceil(height / IMAGE_STEP_PX)];
  }
}

// Gets a camera image, of a keyframe or live, and the model's picture from the same pose, and compares them.

import type { KeyframePhotos, Photo } from "../connection/keyframe_photos";
import type { KeyframeImageHeader, LiveImageHeader, NumberedKeyframe, PosedCamera } from "../connection/protocol";
import type { PictureRequest, SidePicture, SideView } from "../layers/side_view";
import { decodeDepth } from "../layers/depth_part";
import { decodeJpeg } from "../layers/jpeg";
import { inflated } from "../layers/zlib";
import { compareKeyframe, type KeyframeErrors } from "./keyframe_error";
import { keyframeKey } from "./keyframe_order";
import { reasonOf } from "./sentence";

/**
 * A photograph with its mask. The mask has one byte per pixel, 0 where the photograph is not used.
 * It is null if all pixels are used.
 */
export interface DecodedPhoto {
  /** Null for live images. */
  header: KeyframeImageHeader | null;
  image: ImageData;
  mask: Uint8Array | null;
}

export interface Comparison {
  /** The photograph, or the reason why there is none. */
  photo: DecodedPhoto | string;
  /** The model's picture, or the reason why there is none. */
  render: ImageData | string;
  /** Time at which the newest keyframe of the model was taken, on the server's clock; null if unknown. */
  newestMillis: number | null;
  /** Null if one of the two is missing. */
  errors: KeyframeErrors | null;
}

/** What requests for pictures of the model have in common: the model, the clipping distances and the background. */
export type CommonRequest = Omit<PictureRequest, "world_from_camera" | "size_px" | "projection" | "crop" | "outputs">;

/** Maximum time to wait for a picture. If it takes longer, the server is busy, for example with saving. */
const TIMEOUT_MILLIS = 30_000;

/** A live image with its pose. */
export interface PosedImage {
  header: LiveImageHeader & PosedCamera;
  jpeg: Uint8Array<ArrayBuffer>;
}

/** The model's picture, and which of its pixels show a surface; null if that is unknown. */
interface Render {
  image: ImageData;
  surface: Uint8Array | null;
  newestMillis: number | null;
}

/** Gets pictures of the model from the poses of cameras. */
export class PoseRenderer {
  constructor(
    private readonly side: SideView,
    private readonly common: () => CommonRequest,
  ) {}

  /** Ends the pending request, because its picture is not worth waiting for. */
  abandon(reason: string): void {
    this.side.abandon(reason);
  }

  /** The model from the pose of a camera, at this size, or the reason why there is no picture. */
  async render(camera: PosedCamera, [width, height]: [number, number]): Promise<Render | string> {
    if (!this.side.isPossible) return "the server draws no other views";
    const [scaleX, scaleY] = [width / camera.size_px[0], height / camera.size_px[1]];
    const request: PictureRequest = {
      ...this.common(),
      world_from_camera: camera.world_from_camera,
      size_px: [width, height],
      projection: {
        kind: "pinhole",
        focal_px: [camera.focal_px[0] * scaleX, camera.focal_px[1] * scaleY],
        principal_px: [camera.principal_px[0] * scaleX, camera.principal_px[1] * scaleY],
      },
      outputs: ["color", "depth"],
    };
    const timer = window.setTimeout(() => this.side.abandon("the server has not drawn this view yet"), TIMEOUT_MILLIS);
    try {
      return await decodeRender(await this.side.request(request));
    } catch (error) {
      return reasonOf(error);
    } finally {
      window.clearTimeout(timer);
    }
  }

  /** Compares a live image with the current model. */
  async compareLive({ header, jpeg }: PosedImage): Promise<Comparison> {
    const [photo, render] = await Promise.all([decodeLive(jpeg), this.render(header, header.size_px)]);
    return comparison(photo, render);
  }
}

export class KeyframeComparer {
  /** The photograph that was requested last. */
  private last: { key: string; photo: DecodedPhoto } | null = null;

  constructor(
    private readonly photos: KeyframePhotos,
    private readonly renderer: PoseRenderer,
    private readonly maxPx: [number, number],
    private readonly isUrgent: boolean,
  ) {}

  /** Forgets the photograph, because a new server may have another one under the same name. */
  restart(): void {
    this.last = null;
  }

  /** Compares a keyframe. `onPhoto` is called with its photograph, which usually arrives before the model's picture. */
  async compare(keyframe: NumberedKeyframe, onPhoto?: (photo: DecodedPhoto | string) => void): Promise<Comparison> {
    const sizePx = fitted(keyframe.size_px, this.maxPx);
    const [photo, render] = await Promise.all([
      this.photo(keyframe).then((photo) => {
        onPhoto?.(photo);
        return photo;
      }),
      this.renderer.render(keyframe, sizePx),
    ]);
    return comparison(photo, render);
  }

  private async photo(keyframe: NumberedKeyframe): Promise<DecodedPhoto | string> {
    const key = keyframeKey(keyframe);
    if (this.last?.key === key) return this.last.photo;
    if (!this.photos.isPossible) return "this server sends no photographs";
    try {
      const photo = await decodePhoto(await this.photos.request(keyframe, this.maxPx, this.isUrgent));
      this.last = { key, photo };
      return photo;
    } catch (error) {
      return reasonOf(error);
    }
  }
}

function comparison(photo: DecodedPhoto | string, render: Render | string): Comparison {
  const isComplete = typeof photo !== "string" && typeof render !== "string";
  return {
    photo,
    render: typeof render === "string" ? render : render.image,
    newestMillis: typeof render === "string" ? null : render.newestMillis,
    errors: isComplete ? compareKeyframe(photo.image, render.image, { mask: photo.mask, surface: render.surface }) : null,
  };
}

async function decodeLive(jpeg: Uint8Array<ArrayBuffer>): Promise<DecodedPhoto | string> {
  try {
    return { header: null, image: await pixelsOf(jpeg, { offset: 0, bytes: jpeg.byteLength }), mask: null };
  } catch (error) {
    return reasonOf(error);
  }
}

async function decodePhoto({ header, payload }: Photo): Promise<DecodedPhoto> {
  const { color, mask } = header;
  const image = await pixelsOf(payload, color);
  const nPx = image.width * image.height;
  return {
    header,
    image,
    mask: mask ? await inflated(payload.slice(mask.offset, mask.offset + mask.bytes), nPx) : null,
  };
}

async function decodeRender({ header, payload }: SidePicture): Promise<Render> {
  if (!header.color) throw new Error("the model's picture has no colors");
  const image = await pixelsOf(payload, header.color);
  const newestMillis = header.newest_keyframe?.captured_millis ?? null;
  if (!header.depth) return { image, surface: null, newestMillis };
  const { depth, sizePx } = await decodeDepth(header.depth, payload);
  const surface = new Uint8Array(image.width * image.height);
  for (let y = 0; y < image.height; y++) {
    const row = Math.floor((y * sizePx[1]) / image.height) * sizePx[0];
    for (let x = 0; x < image.width; x++) {
      surface[y * image.width + x] = depth[row + Math.floor((x * sizePx[0]) / image.width)]! > 0 ? 1 : 0;
    }
  }
  return { image, surface, newestMillis };
}

async function pixelsOf(payload: Uint8Array<ArrayBuffer>, part: { offset: number; bytes: number }): Promise<ImageData> {
  const bitmap = await decodeJpeg(payload, part);
  const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d", { willReadFrequently: true });
  if (!context) throw new Error("this browser cannot read pixels of images");
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  return context.getImageData(0, 0, context.canvas.width, context.canvas.height);
}

/** The size of an image that is downscaled to a maximum size, as the server rounds it. */
function fitted([width, height]: [number, number], [maxWidth, maxHeight]: [number, number]): [number, number] {
  const scale = Math.min(1, maxWidth / width, maxHeight / height);
  return [Math.max(1, Math.round(width * scale)), Math.max(1, Math.round(height * scale))];
}

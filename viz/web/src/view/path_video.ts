// Records a video along a camera path: requests each picture in full, and encodes it in a worker.

import { FRAMES_PER_SEC, type PathView } from "./camera_path";
import { decodeJpeg } from "../layers/jpeg";
import type { PictureRequest, SidePicture, SideView } from "../layers/side_view";

/** Messages to the worker. The worker answers each message before the next one is sent. */
export type ToVideoWorker =
  | { kind: "begin"; sizePx: [number, number]; frameRate: number }
  | { kind: "frame"; bitmap: ImageBitmap }
  | { kind: "end" };
export type FromVideoWorker =
  | { kind: "ready" }
  | { kind: "file"; bytes: ArrayBuffer }
  | { kind: "error"; message: string };

/** Why this page cannot encode videos; null if it can. */
export function whyNoVideo(): string | null {
  if (typeof VideoEncoder !== "undefined") return null;
  return window.isSecureContext
    ? "This browser cannot encode videos (it lacks WebCodecs): use a recent version of Chrome, Edge, Firefox or Safari"
    : "Browsers encode videos only on secure pages: start fieldrig with --share and open its https address, or open this page on the server's computer as localhost";
}

export class PathVideo {
  private worker: Worker | null = null;
  private fail: (error: Error) => void = () => undefined;

  constructor(
    private readonly side: SideView,
    private readonly request: (view: PathView, sizePx: [number, number]) => PictureRequest,
  ) {}

  get isRecording(): boolean {
    return this.worker !== null;
  }

  /** Ends the recording; its promise resolves to null. */
  cancel(): void {
    this.end();
    this.side.abandon("cancelled");
    this.fail(new Error("cancelled"));
  }

  /** The video as an MP4 file; null if it was canceled. */
  async record(
    frames: PathView[],
    [width, height]: [number, number],
    progress: (nDone: number) => void,
  ): Promise<Blob | null> {
    const sizePx: [number, number] = [width & ~1, height & ~1]; // Encoders need even sizes.
    const worker = new Worker("video_worker.js");
    this.worker = worker;
    try {
      await this.ask(worker, { kind: "begin", sizePx, frameRate: FRAMES_PER_SEC });
      this.checkIsCurrent(worker);
      for (const [ix, frame] of frames.entries()) {
        progress(ix);
        const picture = await this.side.request(this.request(frame, sizePx));
        this.checkIsCurrent(worker);
        const bitmap = await bitmapOf(picture);
        this.checkIsCurrent(worker);
        await this.ask(worker, { kind: "frame", bitmap }, [bitmap]);
        this.checkIsCurrent(worker);
      }
      progress(frames.length);
      const last = await this.ask(worker, { kind: "end" });
      return last.kind === "file" ? new Blob([last.bytes], { type: "video/mp4" }) : null;
    } catch (error) {
      if (this.worker !== worker) return null;
      throw error;
    } finally {
      if (this.worker === worker) this.end();
    }
  }

  /** Throws if the recording of this worker was canceled, even if another recording has begun. */
  private checkIsCurrent(worker: Worker): void {
    if (this.worker !== worker) throw new Error("cancelled");
  }

  private end(): void {
    this.worker?.terminate();
    this.worker = null;
  }

  private ask(worker: Worker, message: ToVideoWorker, transfer: Transferable[] = []): Promise<FromVideoWorker> {
    return new Promise((resolve, reject) => {
      this.fail = reject;
      worker.onmessage = ({ data }: MessageEvent<FromVideoWorker>) => {
        if (data.kind === "error") reject(new Error(data.message));
        else resolve(data);
      };
      worker.onerror = () => reject(new Error("the encoder could not be loaded"));
      worker.postMessage(message, transfer);
    });
  }
}

function bitmapOf({ header: { color }, payload }: SidePicture): Promise<ImageBitmap> {
  if (!color) throw new Error("received a picture without color");
  return decodeJpeg(payload, color);
}

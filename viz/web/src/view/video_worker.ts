// The worker that encodes videos. It is loaded for the first video only, because it is large.

import { BufferTarget, CanvasSource, getFirstEncodableVideoCodec, Mp4OutputFormat, Output, Quality } from "mediabunny";
import type { FromVideoWorker, ToVideoWorker } from "./path_video";

/** The first codec that the browser can encode is used. All players support H.264. */
const CODECS = ["avc", "vp9", "av1"] as const;

interface Video {
  output: Output<Mp4OutputFormat, BufferTarget>;
  source: CanvasSource;
  canvas: OffscreenCanvas;
  nFrames: number;
  frameRate: number;
}

let video: Video | null = null;

/** Does one step; the page sends the next message after the answer. */
async function step(message: ToVideoWorker): Promise<FromVideoWorker> {
  if (message.kind === "begin") {
    video = await begin(message.sizePx, message.frameRate);
    return { kind: "ready" };
  }
  if (!video) throw new Error("the video has not begun");
  const { output, source, canvas, nFrames, frameRate } = video;
  if (message.kind === "end") {
    await output.finalize();
    return { kind: "file", bytes: output.target.buffer! };
  }
  canvas.getContext("2d")!.drawImage(message.bitmap, 0, 0, canvas.width, canvas.height);
  message.bitmap.close();
  await source.add(nFrames / frameRate, 1 / frameRate);
  video.nFrames += 1;
  return { kind: "ready" };
}

async function begin([width, height]: [number, number], frameRate: number): Promise<Video> {
  const quality = new Quality("high");
  const codec = await getFirstEncodableVideoCodec([...CODECS], { width, height, quality });
  if (!codec) throw new Error(`this browser cannot encode videos of ${width} × ${height} pixels`);
  const canvas = new OffscreenCanvas(width, height);
  const source = new CanvasSource(canvas, { codec, quality });
  const output = new Output({ format: new Mp4OutputFormat(), target: new BufferTarget() });
  output.addVideoTrack(source, { frameRate });
  await output.start();
  return { output, source, canvas, nFrames: 0, frameRate };
}

self.onmessage = async ({ data }: MessageEvent<ToVideoWorker>): Promise<void> => {
  const answer = await step(data).catch(
    (error: unknown): FromVideoWorker => ({
      kind: "error",
      message: error instanceof Error ? error.message : String(error),
    }),
  );
  self.postMessage(answer, answer.kind === "file" ? { transfer: [answer.bytes] } : {});
};

// The messages of docs/reference/protocol.md.

/** Protocol version of this page. */
export const PROTOCOL_VERSION = 3;

export interface Pinhole {
  kind: "pinhole";
  focal_px: [number, number];
  principal_px: [number, number];
}

export interface Hello {
  type: "hello";
  protocol: number;
  server: string;
  client: number;
  max_size_px: [number, number];
  default_stages: number[];
  clock_millis: number;
}

/** Status of a model. */
export interface ModelStatus {
  method: string;
  step: number;
  step_millis: number | null;
  primitives: number;
  primitives_label: string;
  bytes: number;
  psnr: number | null;
  psnr_history: [number, number][];
}

/** Status of the run and of its first model. */
export interface Status extends ModelStatus {
  type: "status";
  state: string;
  seconds: number;
  keyframes: number;
  rejected: Record<string, number>;
  others: ModelStatus[];
  notes: string[];
  result: RunResult | null;
}

/** Result of a run that has ended. */
export interface RunResult {
  folder: string | null;
  scores: string;
  seconds: number;
}

export interface Scene {
  type: "scene";
  center_m: [number, number, number];
  radius_m: number;
  world_from_camera: number[];
}

/** Pose and lens of a camera at one moment; enough to draw its frustum. */
export interface PosedCamera {
  camera: string;
  world_from_camera: number[];
  size_px: [number, number];
  focal_px: [number, number];
  principal_px: [number, number];
}

export interface Keyframes {
  type: "keyframes";
  keyframes: PosedCamera[];
}

export interface ErrorMessage {
  type: "error";
  id: number | null;
  message: string;
}

/** Sent four times a second. */
export interface Heartbeat {
  type: "heartbeat";
  clock_millis: number;
}

/** Answers a ping. */
export interface Pong {
  type: "pong";
  t: number;
  clock_millis: number;
}

export interface Goodbye {
  type: "goodbye";
  reason: string;
}

export interface PictureHeader {
  type: "picture";
  id: number;
  stage: number;
  n_stages: number;
  scale: number;
  last: boolean;
  size_px: [number, number];
  full_size_px: [number, number];
  world_from_camera: number[];
  projection: Pinhole | { kind: "equirectangular" };
  near_m: number;
  far_m: number;
  waited_millis: number;
  render_millis: number;
  encode_millis: number | null;
  keyframes: number | null;
  color: { format: "jpeg"; offset: number; bytes: number } | null;
  depth: {
    format: "u16_half" | "f32";
    size_px: [number, number];
    meters_per_count: number;
    offset: number;
    bytes: number;
  } | null;
}

export interface LiveImageHeader {
  type: "live_image";
  camera: string;
  stamp_nanos: number;
  captured_millis: number;
  size_px: [number, number];
  format: "jpeg";
  world_from_camera: number[] | null;
  focal_px: [number, number];
  principal_px: [number, number];
}

export type TextMessage = Hello | Status | Scene | Keyframes | ErrorMessage | Heartbeat | Pong | Goodbye;
export type BinaryHeader = PictureHeader | LiveImageHeader;

export interface RenderMessage {
  type: "render";
  id: number;
  method?: string | undefined;
  world_from_camera: number[];
  size_px: [number, number];
  projection: Pinhole;
  stages: number[];
  near_m: number;
  far_m: number;
  outputs: ("color" | "depth")[];
  background_srgb: [number, number, number];
}

export interface PingMessage {
  type: "ping";
  t: number;
}

export type ClientMessage = RenderMessage | PingMessage;

/** Header and payload of a binary message: u32 little-endian header length, JSON header, payload. */
export function unframe(message: ArrayBuffer): { header: BinaryHeader; payload: Uint8Array<ArrayBuffer> } {
  const nHeader = new DataView(message).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(message, 4, nHeader))) as BinaryHeader;
  return { header, payload: new Uint8Array(message, 4 + nHeader) };
}

// The messages of docs/reference/protocol.md.

import type { Crop } from "../view/oriented_box";

/** Newest protocol version of this page. */
export const PROTOCOL_VERSION = 4;
/** Oldest protocol version of this page. */
export const OLDEST_PROTOCOL_VERSION = 3;
/** Capabilities that this page can use, except those of topics. */
export const CAPABILITIES = [
  "views",
  "subscribe",
  "compact_depth",
  "keyframe_changes",
  "parts",
  "heartbeat",
  "control",
  "edit",
  "shown",
  "keyframe_images",
] as const;
export type Capability = (typeof CAPABILITIES)[number];

export interface Pinhole {
  kind: "pinhole";
  focal_px: [number, number];
  principal_px: [number, number];
}

export type Projection = Pinhole | { kind: "equirectangular" };

/** What the page may do; only operators can change the run. */
export type Role = "viewer" | "operator";

export interface Hello {
  type: "hello";
  protocol: number;
  /** Oldest and newest version of the server; servers before version 4 have none. */
  protocols?: [number, number];
  capabilities?: string[];
  server: string;
  client: number;
  /** Servers before the capability `control` have none. */
  role: Role | undefined;
  max_size_px: [number, number];
  default_stages: number[];
  clock_millis: number;
  /** Whether the server has a workspace with which pages start; older servers have none. */
  has_workspace?: boolean;
}

/** Reply to the page's hello. */
export interface Welcome {
  type: "welcome";
  protocol: number;
  capabilities: string[];
}

/** Status of a model. */
export interface ModelStatus {
  method: string;
  step: number;
  step_millis: number | null;
  primitives: number;
  primitives_label: string;
  bytes: number;
  /** Whether the page can draw the model itself; missing on older servers. */
  has_chunks: boolean;
  /** Number of edits that can be undone; missing on older servers. */
  edits: number;
  /** Number of undone edits that can be redone; missing on older servers. */
  undone_edits?: number;
  /** The erased boxes in world, which cut splats; missing if there are none. */
  erased_boxes?: Crop[];
  psnr: number | null;
  psnr_history: [number, number][];
}

/** Status of the run and of its first model. */
export interface Status extends ModelStatus {
  type: "status";
  state: string;
  /** Progress of the work that `state` names; missing if it is not known. */
  progress?: StateProgress;
  seconds: number;
  keyframes: number;
  rejected: Record<string, number>;
  others: ModelStatus[];
  /** Changes whenever the edits of a model change; missing on older servers. */
  edit_revision: number;
  /** The last edit; missing before the first one. */
  last_edit?: LastEdit;
  /** Result of the last request to save edits; missing before the first one. */
  saved_edits?: SavedEdits;
  notes: string[];
  result: RunResult | null;
  guidance?: Guidance;
  /** The devices of a preview, which trains nothing. */
  preview?: PreviewStatus;
  /** These fields are for the operator's header; older servers have none of them. */
  identity?: Identity;
  advice?: Advice;
  images?: ImageCounts;
  store?: KeyframeStore;
  clients?: { id: number; role: Role }[];
  paused_by?: number;
  input_ended?: boolean;
  checkpoint?: { state: "requested" | "written" | "failed"; text: string };
  /** The notes that only inform. */
  infos?: string[];
  /** The saved model or file that is viewed; missing in a run, and on older servers. */
  source?: ModelSource;
  /** Files that can be downloaded. */
  files?: FileLink[];
  /** Whether the server has the WebSocket `/steer`; missing in runs without motion, and on older servers. */
  steering?: boolean;
}

/** Which robot and run a server shows. */
export interface Identity {
  rig: string | null;
  robot: string | null;
  run: string | null;
}

/** What the run does, and what the operator should do. */
export interface Advice {
  text: string;
  is_warning: boolean;
}

/** What happened to the images since the start of the run. */
export interface ImageCounts {
  received: number;
  dropped: number;
  accepted: number;
  evicted: number;
}

/** How full the store of keyframes is. */
export interface KeyframeStore {
  keyframes: number;
  max_keyframes: number;
  bytes: number;
  max_bytes: number;
  is_full: boolean;
}

/** Progress of the work that a state names. */
export interface StateProgress {
  text: string;
  /** Completed part of the work, 0 to 1; null if it is not known. */
  done_frac: number | null;
  /** Whether the model has not been started yet, so that pictures may be empty or missing. */
  is_startup: boolean;
}

/** An edit, and the client that requested it. */
export interface LastEdit {
  client: number;
  /** What was done, such as "erased a box". */
  text: string;
}

/** Where edits were saved, or why they could not be saved. */
export interface SavedEdits {
  /** Counts the requests. */
  revision: number;
  text: string;
  has_failed: boolean;
}

/** What the operator should do, while images are taken for a calibration. */
export interface Guidance {
  text: string;
  is_finished: boolean;
  /** What the photographs for a lens cover; missing for other calibrations, and on older servers. */
  coverage?: PhotographCoverage;
}

/** What the photographs of a target cover so far. */
export interface PhotographCoverage {
  camera: string;
  size_px: [number, number];
  /** Number of columns and rows of equal cells of the image. */
  cells: [number, number];
  /** Whether each cell contains corners of the target, row by row from the upper left. */
  is_covered: boolean[];
  /** Parts of the image that need corners, 3 rows of 3, from the upper left. */
  parts: { is_covered: boolean; is_next: boolean }[];
  /** Everything else that photographs must show. */
  items: { label: string; n_done: number; n_needed: number; is_next: boolean }[];
}

/** What a preview shows besides images and the robot. */
export interface PreviewStatus {
  devices: DeviceStatus[];
}

/** A device that is read, or that cannot be read. */
export interface DeviceStatus {
  /** For display, such as `camera "wrist"`. */
  name: string;
  state: "opening" | "delivering" | "silent" | "failed" | "ended";
  /** Samples per second over the last seconds; null if too few samples arrived. */
  rate_hz: number | null;
  /** The same according to the rig file; null if the rig file does not say. */
  expected_hz: number | null;
  /** Time since the newest sample was captured; null before the first sample. */
  age_millis: number | null;
  /** Why there are no samples; empty if samples arrive. */
  reason: string;
}

/** Result of a run that has ended. */
export interface RunResult {
  folder: string | null;
  scores: string;
  seconds: number;
  /** Missing on older servers. */
  verdict?: Verdict;
  /** Errors that ended the run, and lost data, one sentence each. */
  problems?: string[];
}

/** How good a result is. */
export interface Verdict {
  grade: "good" | "fair" | "poor" | "unknown";
  /** One sentence without a period. */
  text: string;
}

/** An axis of a model. */
export type Axis = "x" | "y" | "z" | "-x" | "-y" | "-z";

/** The saved model or file that is viewed. */
export interface ModelSource {
  kind: "saved" | "file";
  name: string;
  path: string;
  format: string | null;
  bytes: number;
  modified_unix_secs: number | null;
  data: string | null;
  adapter: string | null;
  verdict: Verdict | null;
  /** Axis of the model that points up on the page. */
  up_axis: Axis;
}

/** A file that the server offers. */
export interface FileLink {
  path: string;
  label: string;
  /** Whether browsers show it instead of saving it. */
  is_page: boolean;
}

export interface Scene {
  type: "scene";
  center_m: [number, number, number];
  radius_m: number;
  world_from_camera: number[];
  /**
   * Bounds of the relevant parts, without the robot. Missing on older servers, whose center and
   * radius cover only the first keyframes.
   */
  bounds?: { min_m: [number, number, number]; max_m: [number, number, number] };
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

/** A keyframe with its number in the server's list. */
export interface NumberedKeyframe extends PosedCamera {
  id: number;
  stamp_nanos: number;
}

/** Changes of the list of keyframes. A message from version 0 replaces the list. */
export interface KeyframeChanges {
  type: "keyframe_changes";
  from_version: number;
  version: number;
  keyframes: NumberedKeyframe[];
  removed: number[];
}

export type RobotShape = {
  link_from_shape: number[];
  color_srgba: [number, number, number, number] | null;
} & (
  | { kind: "box"; size_m: [number, number, number] }
  | { kind: "cylinder" | "capsule"; radius_m: number; length_m: number }
  | { kind: "sphere"; radius_m: number }
  | { kind: "mesh"; url: string; format: "stl" | "dae" | "obj"; scale: [number, number, number] }
);

export interface RobotJoint {
  name: string;
  kind: "fixed" | "revolute" | "prismatic";
  parent: string;
  child: string;
  parent_from_joint: number[];
  axis: [number, number, number];
  mimic: { source: string; multiplier: number; offset: number } | null;
}

/** Links, joints and shapes of the robot. */
export interface Robot {
  type: "robot";
  name: string;
  base_link: string;
  joint_names: string[];
  links: { name: string; shapes: RobotShape[] }[];
  joints: RobotJoint[];
}

/** Positions of a moving base so far. */
export interface BasePath {
  type: "base_path";
  /** In world, oldest first. */
  points_m: [number, number, number][];
  /** Indices of the points to which the base has not driven from the previous point; missing on older servers. */
  line_starts?: number[];
}

/** Joint positions and base pose of the robot. */
export interface RobotState {
  type: "robot_state";
  stamp_nanos: number;
  captured_millis: number;
  world_from_base: number[];
  positions: number[];
}

export interface ErrorMessage {
  type: "error";
  id: number | null;
  view?: string;
  /** Number of the keyframe, in replies to `keyframe_image`. */
  keyframe?: number;
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
  view?: string;
  stage: number;
  n_stages: number;
  scale: number;
  last: boolean;
  size_px: [number, number];
  full_size_px: [number, number];
  /** The model that was drawn, and its number of steps; missing on older servers. */
  method?: string;
  step?: number;
  world_from_camera: number[];
  projection: Projection;
  near_m: number;
  far_m: number;
  waited_millis: number;
  render_millis: number;
  encode_millis: number | null;
  keyframes: number | null;
  /** Times of the keyframe that was added last to the model, on the server's clock; missing on older servers. */
  newest_keyframe: { captured_millis: number; added_millis: number } | null | undefined;
  sent_millis: number;
  color: { format: "jpeg"; offset: number; bytes: number } | null;
  depth: DepthPart | null;
}

export type DepthPart = {
  size_px: [number, number];
  offset: number;
  bytes: number;
} & (
  | { format: "u16_half" | "f32"; meters_per_count: number }
  | { format: "compact_half"; min_m: number; log_step: number }
);

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

/** Points of a keyframe, in its camera frame. */
export interface KeyframePointsHeader {
  type: "keyframe_points";
  /** Number of the keyframe. */
  id: number;
  n_points: number;
  meters_per_count: number;
}

/** The photograph of a keyframe: the undistorted image that the model is trained on. */
export interface KeyframeImageHeader {
  type: "keyframe_image";
  /** Number of the request. */
  id: number;
  /** Number of the keyframe. */
  keyframe: number;
  camera: string;
  stamp_nanos: number;
  size_px: [number, number];
  full_size_px: [number, number];
  split: "train" | "validation" | "test";
  has_depth: boolean;
  /** Pose before the corrections that the model has estimated, row major. */
  reported_world_from_camera: number[];
  /** Speed of the camera at mid-exposure; null if unknown. */
  speed_m_s: number | null;
  turn_rad_s: number | null;
  /** Time from the exposure of the first row to the exposure of the last row. */
  readout_secs: number;
  color: { format: "jpeg"; offset: number; bytes: number };
  /** A zlib stream of one byte per pixel, 0 where the photograph is not used. Null if all pixels are used. */
  mask: { offset: number; bytes: number } | null;
}

interface ChunkHeader {
  type: "model_chunk";
  /** The model. */
  method: string;
  id: number;
  /** Whether the chunk is only an approximation. */
  is_coarse: boolean;
  /** Number of chunks of the model, and of those that are missing or coarse after this message. */
  n_chunks: number;
  n_incomplete: number;
  /** Number of chunks that are missing after this message; missing on older servers. */
  n_unsent: number | undefined;
  /** The same numbers for the view of the newest request. Null if there was no request, missing on older servers. */
  n_incomplete_in_view: number | null | undefined;
  n_unsent_in_view: number | null | undefined;
  world_from_model: number[];
}

/** A part of a mesh. */
export interface MeshChunkHeader extends ChunkHeader {
  kind: "mesh";
  origin_m: [number, number, number];
  meters_per_count: number;
  n_vertices: number;
  n_triangles: number;
}

/** Gaussian splats in a box. */
export interface SplatChunkHeader extends ChunkHeader {
  kind: "splats";
  n_splats: number;
  min_m: [number, number, number];
  max_m: [number, number, number];
  log_scale_range: [number, number];
  scale_factor: number;
  sh_degree: number;
  sh_ranges: [number, number];
  is_antialiased: boolean;
}

export type ModelChunkHeader = MeshChunkHeader | SplatChunkHeader;

/** Chunks that no longer exist. */
export interface ModelChunksRemoved {
  type: "model_chunks_removed";
  method: string;
  ids: number[];
}

/** A part of a binary message that is `bytes` long. */
export interface PartHeader {
  type: "part";
  message: number;
  offset: number;
  bytes: number;
}

/** A scan of a range scanner, in world axes relative to the scanner. */
export interface RangeScanHeader {
  type: "range_scan";
  scanner: string;
  stamp_nanos: number;
  /** Start of the revolution on the server's clock; missing on older servers. */
  captured_millis?: number;
  origin_m: [number, number, number];
  n_points: number;
  meters_per_count: number;
}

/** When and how precisely each part of the scene was observed. */
export interface ObservationsHeader {
  type: "observations";
  min_m: [number, number, number];
  cell_m: number;
  n_cells: [number, number, number];
  n_keyframes: number;
  newest_millis: number | null;
  min_age_secs: number;
  min_sigma_m: number;
  log_step: number;
}

/** Every text message from the server. */
export type TextMessage =
  | Hello
  | Welcome
  | Status
  | Scene
  | Keyframes
  | KeyframeChanges
  | Robot
  | RobotState
  | BasePath
  | ModelChunksRemoved
  | ErrorMessage
  | Heartbeat
  | Pong
  | Goodbye;

/** Every header of a binary message from the server, except of parts. */
export type BinaryHeader =
  | PictureHeader
  | LiveImageHeader
  | KeyframePointsHeader
  | KeyframeImageHeader
  | RangeScanHeader
  | ObservationsHeader
  | ModelChunkHeader;

export interface HelloMessage {
  type: "hello";
  protocols: [number, number];
  capabilities: readonly string[];
}

export interface SubscribeMessage {
  type: "subscribe";
  topic: string;
  rate_hz: number;
  camera?: string;
  size_px?: [number, number];
  method?: string;
}

export interface ControlMessage {
  type: "control";
  action: "pause" | "resume" | "save";
}

/** Erases parts of a model, or undoes this. */
export interface EditMessage {
  type: "edit";
  id: number;
  action: "erase" | "remove_floaters" | "undo" | "redo";
  box?: Crop;
  method?: string | undefined;
}

export interface RenderMessage {
  type: "render";
  id: number;
  /** Name of the view; the main view has none. */
  view?: string;
  method?: string | undefined;
  world_from_camera: number[];
  size_px: [number, number];
  projection: Projection;
  stages: number[];
  near_m: number;
  far_m: number;
  crop?: { min_m: [number, number, number]; max_m: [number, number, number] } | undefined;
  outputs: ("color" | "depth")[];
  depth_format?: "compact_half" | undefined;
  background_srgb: [number, number, number];
}

export interface ShownMessage {
  type: "shown";
  id: number;
  shown_millis: number;
}

/** Requests the photograph of a keyframe. */
export interface KeyframeImageMessage {
  type: "keyframe_image";
  id: number;
  /** Number of the keyframe. */
  keyframe: number;
  /** Maximum size. */
  size_px: [number, number];
}

export interface PingMessage {
  type: "ping";
  t: number;
}

export type ClientMessage =
  | HelloMessage
  | RenderMessage
  | SubscribeMessage
  | ControlMessage
  | ShownMessage
  | EditMessage
  | KeyframeImageMessage
  | PingMessage;

/** Header and payload of a binary message: u32 little-endian header length, JSON header, payload. */
export function unframe(message: ArrayBuffer): {
  header: BinaryHeader | PartHeader;
  payload: Uint8Array<ArrayBuffer>;
} {
  const nHeader = new DataView(message).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(message, 4, nHeader))) as BinaryHeader | PartHeader;
  return { header, payload: new Uint8Array(message, 4 + nHeader) };
}

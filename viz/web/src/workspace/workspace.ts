// Workspace files: what an operator sees, as JSON, so that the page, a headset and other operators open the same. The format is
// in docs/reference/workspace.md, and tests compare this module with the schema beside it.
//
// A file may come from anybody. Reading it never fails: the result is a workspace, or one sentence with the first mistake.

import type { ViewMode } from "../view/view_state";

type Point = [number, number, number];

/**
 * How the model is drawn. `pictures`: the server sends pictures. `direct`: this device draws the splats or the mesh. `panel`
 * and `sphere`: in a headset, pictures on a panel in the hand or all around. Without a headset, they are pictures.
 */
export type DrawingMode = "pictures" | "direct" | "panel" | "sphere";

/** A view of the camera path. */
export interface WorkspacePathView {
  position_m: Point;
  target_m: Point;
  fov_degrees: number;
}

export interface WorkspaceCamera {
  mode: ViewMode;
  /** The eye and the point that it orbits, in world. */
  position_m: Point;
  target_m: Point;
  /** Upward direction of the picture, in world. */
  up: Point;
  /** Vertical field of view. */
  fov_degrees?: number;
  /** The followed frame in the mode `chase`, or the camera in the mode `ride`. */
  attached_to?: string;
}

export interface WorkspaceBox {
  center_m: Point;
  /** Lengths of the sides. */
  size_m: Point;
  /** Rotation about the vertical axis. */
  yaw_rad: number;
}

export interface WorkspacePanels {
  /** Whether the panel beside the view is shown. */
  side?: boolean;
  /** The open panel below the toolbar. */
  open?: string;
  /** Cameras whose images are in the panel beside the view. */
  docked_cameras?: string[];
}

/** All parts are optional. What a file leaves out stays as it is. */
export interface Workspace {
  camera?: WorkspaceCamera;
  /** The crop box, and whether the scene is cropped to it. A box that follows the scene has no sides. */
  crop?: { is_on: boolean; box?: WorkspaceBox };
  /** Layers by name, and whether they are drawn. Readers ignore names that they do not know. */
  layers?: Record<string, boolean>;
  panels?: WorkspacePanels;
  /** The method of the shown model. */
  model?: string;
  mode?: DrawingMode;
  path?: WorkspacePathView[];
}

export const FORMAT = "fieldrig-workspace";
export const VERSION = 1;
export const DRAWING_MODES: readonly DrawingMode[] = ["pictures", "direct", "panel", "sphere"];
export const VIEW_MODES: readonly ViewMode[] = ["overview", "orbit", "fly", "chase", "ride"];
/** Far more than a workspace with all layers and the longest path. */
export const MAX_BYTES = 65_536;
export const MAX_PATH_VIEWS = 64;
export const MAX_NAMES = 64;
/** Beyond it, single-precision numbers of the GPU are too coarse. */
export const MAX_COORDINATE_M = 1e5;
export const FOV_DEGREES: readonly [number, number] = [1, 150];
/** Names of layers, panels and methods. */
export const NAME = /^[a-z0-9_-]{1,32}$/;
/** Names of cameras and robot links may have any printable characters. */
export const FRAME = /^[^\p{C}]{1,64}$/u;
const MIN_VIEW_DISTANCE_M = 1e-5;
/** The file is read by people, too: positions are rounded to a micrometer. */
const DECIMALS = 6;

/** The text of a workspace file. */
export function workspaceText(workspace: Workspace): string {
  const rounded = (_key: string, value: unknown): unknown =>
    typeof value === "number" ? Number(value.toFixed(DECIMALS)) : value;
  return `${JSON.stringify({ format: FORMAT, version: VERSION, ...workspace }, rounded, 2)}\n`;
}

/** Reads the text of a workspace file. If it is none, returns the reason in one sentence. */
export function workspaceIn(text: string): Workspace | string {
  try {
    return workspaceOf(parsed(text));
  } catch (error) {
    if (error instanceof Mistake) return error.message;
    throw error;
  }
}

/** A mistake in a file. */
class Mistake extends Error {}

function parsed(text: string): unknown {
  if (text.length > MAX_BYTES) throw new Mistake(`it has more than ${MAX_BYTES} bytes, expected a file saved by fieldrig`);
  try {
    return JSON.parse(text);
  } catch {
    throw new Mistake("it is not JSON, expected a file saved by fieldrig");
  }
}

function workspaceOf(value: unknown): Workspace {
  const file = objectAt("", value);
  // Other files come first: each of their keys would be unknown.
  if (file.format !== FORMAT) throw new Mistake(`format is ${shown(file.format)}, expected "${FORMAT}"`);
  if (file.version !== VERSION) {
    throw new Mistake(`version is ${shown(file.version)}, expected ${VERSION}: open the file with the fieldrig that saved it`);
  }
  refuseOthers("", file, ["format", "version", "camera", "crop", "layers", "panels", "model", "mode", "path"]);
  return {
    ...optional("camera", file.camera, cameraAt),
    ...optional("crop", file.crop, cropAt),
    ...optional("layers", file.layers, layersAt),
    ...optional("panels", file.panels, panelsAt),
    ...optional("model", file.model, nameAt),
    ...optional("mode", file.mode, (path, mode) => oneOf(path, mode, DRAWING_MODES)),
    ...optional("path", file.path, (path, views) => listAt(path, views, MAX_PATH_VIEWS, pathViewAt)),
  };
}

function cameraAt(path: string, value: unknown): WorkspaceCamera {
  const camera = objectAt(path, value);
  refuseOthers(path, camera, ["mode", "position_m", "target_m", "up", "fov_degrees", "attached_to"]);
  const eye = eyeAt(path, camera);
  const up = camera.up === undefined ? ([0, 0, 1] satisfies Point) : pointAt(`${path}.up`, camera.up);
  const length = Math.hypot(...up);
  if (!(length > 0.5 && length < 2)) throw new Mistake(`${path}.up has the length ${shown(length)}, expected 1`);
  return {
    mode: oneOf(`${path}.mode`, camera.mode, VIEW_MODES),
    ...eye,
    up,
    ...optional("fov_degrees", camera.fov_degrees, (_, fov) => fovAt(path, fov)),
    ...optional("attached_to", camera.attached_to, (_, name) => frameAt(`${path}.attached_to`, name)),
  };
}

function pathViewAt(path: string, value: unknown): WorkspacePathView {
  const view = objectAt(path, value);
  refuseOthers(path, view, ["position_m", "target_m", "fov_degrees"]);
  return { ...eyeAt(path, view), fov_degrees: fovAt(path, view.fov_degrees) };
}

function eyeAt(path: string, view: Record<string, unknown>): { position_m: Point; target_m: Point } {
  const position = pointAt(`${path}.position_m`, view.position_m);
  const target = pointAt(`${path}.target_m`, view.target_m);
  const distance = Math.hypot(...position.map((value, axis) => value - target[axis]!));
  if (!(distance > MIN_VIEW_DISTANCE_M)) {
    throw new Mistake(`${path}.target_m is the same place as ${path}.position_m, expected a point that the camera looks at`);
  }
  return { position_m: position, target_m: target };
}

function fovAt(path: string, value: unknown): number {
  const [min, max] = FOV_DEGREES;
  return numberAt(`${path}.fov_degrees`, value, min, max);
}

function cropAt(path: string, value: unknown): NonNullable<Workspace["crop"]> {
  const crop = objectAt(path, value);
  refuseOthers(path, crop, ["is_on", "box"]);
  return { is_on: flagAt(`${path}.is_on`, crop.is_on), ...optional("box", crop.box, (_, box) => boxAt(`${path}.box`, box)) };
}

function boxAt(path: string, value: unknown): WorkspaceBox {
  const box = objectAt(path, value);
  refuseOthers(path, box, ["center_m", "size_m", "yaw_rad"]);
  const size = pointAt(`${path}.size_m`, box.size_m);
  if (!size.every((length) => length > 0)) {
    throw new Mistake(`${path}.size_m is ${shown(size)}, expected lengths of more than 0`);
  }
  return {
    center_m: pointAt(`${path}.center_m`, box.center_m),
    size_m: size,
    yaw_rad: box.yaw_rad === undefined ? 0 : numberAt(`${path}.yaw_rad`, box.yaw_rad, -2 * Math.PI, 2 * Math.PI),
  };
}

function layersAt(path: string, value: unknown): Record<string, boolean> {
  const layers = Object.entries(objectAt(path, value));
  if (layers.length > MAX_NAMES) throw new Mistake(`${path} has ${layers.length} entries, expected at most ${MAX_NAMES}`);
  return Object.fromEntries(layers.map(([name, isOn]) => [nameAt(path, name), flagAt(`${path}.${name}`, isOn)]));
}

function panelsAt(path: string, value: unknown): WorkspacePanels {
  const panels = objectAt(path, value);
  refuseOthers(path, panels, ["side", "open", "docked_cameras"]);
  return {
    ...optional("side", panels.side, (_, isShown) => flagAt(`${path}.side`, isShown)),
    ...optional("open", panels.open, (_, name) => nameAt(`${path}.open`, name)),
    ...optional("docked_cameras", panels.docked_cameras, (_, names) =>
      listAt(`${path}.docked_cameras`, names, MAX_NAMES, frameAt),
    ),
  };
}

/** An object with this key, unless the value is absent. */
function optional<K extends string, T>(
  key: K,
  value: unknown,
  read: (path: string, value: unknown) => T,
): Partial<Record<K, T>> {
  return value === undefined ? {} : ({ [key]: read(key, value) } as Record<K, T>);
}

function objectAt(path: string, value: unknown): Record<string, unknown> {
  if (typeof value === "object" && value !== null && !Array.isArray(value)) return value as Record<string, unknown>;
  throw new Mistake(`${path || "the file"} is ${shown(value)}, expected an object`);
}

function refuseOthers(path: string, value: Record<string, unknown>, known: readonly string[]): void {
  const other = Object.keys(value).find((key) => !known.includes(key));
  if (other === undefined) return;
  throw new Mistake(`${path ? `${path} has` : "it has"} the unknown key ${shown(other)}, expected only ${known.join(", ")}`);
}

function listAt<T>(path: string, value: unknown, max: number, read: (path: string, value: unknown) => T): T[] {
  if (!Array.isArray(value)) throw new Mistake(`${path} is ${shown(value)}, expected a list`);
  if (value.length > max) throw new Mistake(`${path} has ${value.length} entries, expected at most ${max}`);
  return value.map((entry, ix) => read(`${path}[${ix}]`, entry));
}

function pointAt(path: string, value: unknown): Point {
  if (!Array.isArray(value) || value.length !== 3) throw new Mistake(`${path} is ${shown(value)}, expected a list of 3 numbers`);
  return value.map((entry) => numberAt(path, entry, -MAX_COORDINATE_M, MAX_COORDINATE_M)) as Point;
}

function numberAt(path: string, value: unknown, min: number, max: number): number {
  if (typeof value === "number" && value >= min && value <= max) return value;
  throw new Mistake(`${path} is ${shown(value)}, expected a number from ${shown(min)} to ${shown(max)}`);
}

function flagAt(path: string, value: unknown): boolean {
  if (typeof value === "boolean") return value;
  throw new Mistake(`${path} is ${shown(value)}, expected true or false`);
}

function nameAt(path: string, value: unknown): string {
  if (typeof value === "string" && NAME.test(value)) return value;
  throw new Mistake(`${path} has the name ${shown(value)}, expected up to 32 of a-z, 0-9, - and _`);
}

function frameAt(path: string, value: unknown): string {
  if (typeof value === "string" && FRAME.test(value)) return value;
  throw new Mistake(`${path} is ${shown(value)}, expected a name of up to 64 characters`);
}

function oneOf<T extends string>(path: string, value: unknown, known: readonly T[]): T {
  const found = known.find((name) => name === value);
  if (found !== undefined) return found;
  throw new Mistake(`${path} is ${shown(value)}, expected ${known.join(", ")}`);
}

/** A value in a sentence. Long values are shortened. */
function shown(value: unknown): string {
  if (value === undefined) return "missing";
  if (typeof value === "number") return String(Number(value.toFixed(3)));
  if (Array.isArray(value) && value.length > 8) return `a list of ${value.length} entries`;
  if (typeof value === "object" && value !== null && !Array.isArray(value)) return "an object";
  const text = JSON.stringify(value).replace(/\p{C}/gu, "?");
  return text.length > 40 ? `${text.slice(0, 37)}...` : text;
}

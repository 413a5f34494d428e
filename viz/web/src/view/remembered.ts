// The state of the view as a short text, for links and for the storage of the browser.
//
// The text may come from a link that somebody else has written. Reading it never fails. Every
// number, name and list is limited, and malformed parts are left out. The text only has characters
// that need no escapes in an address, and that chat programs keep when they recognize a link:
// letters, digits, `-`, `.`, `_` and `~`.

import { isViewMode, type ViewMode, type ViewState } from "./view_state";

type Point = [number, number, number];

/** A view of the camera path: eye and target in world, meters. */
export interface RememberedPathView {
  position: Point;
  target: Point;
  fovDegrees: number;
}

/** The crop box, in world. */
export interface RememberedBox {
  /** Meters. */
  center: Point;
  /** Lengths of the sides, meters. */
  size: Point;
  /** Rotation about the vertical axis, radians. */
  yaw: number;
}

export interface Remembered {
  view: ViewState | null;
  /** Names of the switches, such as layers, that are not in their initial state. */
  switched: string[];
  /** The crop box, if the user has changed it. */
  crop: RememberedBox | null;
  /** The model, if the user has chosen one. */
  method: string | null;
  path: RememberedPathView[];
}

export const NOTHING: Remembered = { view: null, switched: [], crop: null, method: null, path: [] };

/** Name of the parameter, in the fragment of an address, whose value is the text. */
const PARAMETER = "view";
const VERSION = "1";
const MAX_TEXT_LENGTH = 8192;
const MAX_SWITCHES = 64;
/** Maximum number of views, because a link with more views is too long for some programs. */
export const MAX_PATH_VIEWS = 64;
/** Maximum coordinate, meters. Beyond it, single-precision numbers of the GPU are too coarse. */
const MAX_COORDINATE_M = 1e5;
const MIN_FOV_DEGREES = 1;
const MAX_FOV_DEGREES = 150;
const MIN_VIEW_DISTANCE_M = 1e-5;
/** Views are rounded to a micrometer, because a view that is restored after a reload must not differ visibly. */
const VIEW_DECIMALS = 6;
/** Paths are long, so their views are rounded to a tenth of a millimeter. */
const PATH_DECIMALS = 4;

const NUMBER = /^-?\d{1,6}(\.\d{1,6})?$/;
/** Names of switches, which are ids of buttons. */
const NAME = /^[a-z0-9-]{1,32}$/;
const METHOD = /^[a-z0-9_-]{1,32}$/;
/** Names of robot links and cameras. Names with other characters are left out. */
const FRAME = /^[\w.-]{1,64}$/;
const UPRIGHT: Point = [0, 0, 1];
/** Most views orbit, so their texts do not contain the mode. */
const DEFAULT_MODE: ViewMode = "orbit";

/** Text for [`decoded`]. */
export function encoded({ view, switched, crop, method, path }: Remembered): string {
  const parts = [VERSION];
  if (view) {
    parts.push(`p${numbers(view.position, VIEW_DECIMALS)}`, `t${numbers(view.target, VIEW_DECIMALS)}`);
    const { mode, attachedTo, fovDegrees } = view;
    // Only a view that rides on a camera may be tilted sideways.
    if (mode === "ride") parts.push(`u${numbers(view.up, VIEW_DECIMALS)}`);
    const isNamed = attachedTo !== undefined && FRAME.test(attachedTo);
    if (mode !== DEFAULT_MODE) parts.push(`m${mode}`);
    if (isNamed) parts.push(`a${attachedTo}`);
    if (fovDegrees !== undefined) parts.push(`f${numbers([fovDegrees], 2)}`);
  }
  if (switched.length > 0) parts.push(`l${switched.join("_")}`);
  if (crop) parts.push(`c${numbers([...crop.center, ...crop.size, crop.yaw], PATH_DECIMALS)}`);
  if (method !== null) parts.push(`s${method}`);
  const views = path.slice(0, MAX_PATH_VIEWS);
  if (views.length > 0) parts.push(`k${views.length}_${numbers(views.flatMap(pathNumbers), PATH_DECIMALS)}`);
  return parts.join("~");
}

/** Reads the text of [`encoded`]; null if it is not of this version or remembers nothing. */
export function decoded(text: string): Remembered | null {
  if (text.length > MAX_TEXT_LENGTH) return null;
  const [version, ...parts] = text.split("~");
  if (version !== VERSION) return null;
  // If several parts begin with the same letter, the first one counts. Letters of newer versions of
  // the page are ignored.
  const part = (letter: string): string => parts.find((each) => each.startsWith(letter))?.slice(1) ?? "";
  const method = part("s");
  const remembered = {
    view: viewOf(part),
    switched: names(part("l")),
    crop: cropOf(part("c")),
    method: METHOD.test(method) ? method : null,
    path: pathOf(part("k")),
  };
  return encoded(remembered) === VERSION ? null : remembered;
}

/** The text in the fragment of an address, for [`decoded`]; null if there is none. */
export function textInFragment(fragment: string): string | null {
  return new URLSearchParams(fragment.slice(1)).get(PARAMETER);
}

/** A fragment with only this text, and in particular without a token. */
export function fragmentWith(text: string): string {
  return `#${PARAMETER}=${text}`;
}

/**
 * The fragment without its other parameters, such as a token. Empty if it contains no valid text of
 * a view.
 */
export function onlyView(fragment: string): string {
  const remembered = decoded(textInFragment(fragment) ?? "");
  return remembered ? fragmentWith(encoded(remembered)) : "";
}

/** A link to the view. Queries and other parts of the fragment are left out, because they may be secret. */
export function linkTo({ origin, pathname }: { origin: string; pathname: string }, text: string): string {
  return origin + pathname + fragmentWith(text);
}

function viewOf(part: (letter: string) => string): ViewState | null {
  const position = pointOf(part("p"));
  const target = pointOf(part("t"));
  if (!position || !target || !isLookingAt(position, target)) return null;
  const up = pointOf(part("u"));
  const mode = part("m");
  const fov = numbersOf(part("f"), 1)?.[0];
  const attachedTo = part("a");
  return {
    position,
    target,
    up: up && Math.hypot(...up) > 0.5 && Math.hypot(...up) < 2 ? up : UPRIGHT,
    mode: isViewMode(mode) ? mode : DEFAULT_MODE,
    ...(fov !== undefined && isFov(fov) ? { fovDegrees: fov } : {}),
    ...(FRAME.test(attachedTo) ? { attachedTo } : {}),
  };
}

function cropOf(text: string): RememberedBox | null {
  const box = numbersOf(text, 7);
  if (!box) return null;
  const [center, size] = [box.slice(0, 3) as Point, box.slice(3, 6) as Point];
  const yaw = box[6]!;
  return size.every((length) => length > 0) && Math.abs(yaw) <= 2 * Math.PI ? { center, size, yaw } : null;
}

function pathNumbers({ position, target, fovDegrees }: RememberedPathView): number[] {
  return [...position, ...target, fovDegrees];
}

/**
 * The views of a path. Empty if any view is missing or invalid, because the remaining views would
 * be another path.
 */
function pathOf(text: string): RememberedPathView[] {
  const [count = ""] = text.split("_", 1);
  const nViews = /^\d{1,2}$/.test(count) ? Number(count) : 0;
  if (nViews > MAX_PATH_VIEWS) return [];
  const values = numbersOf(text.slice(count.length + 1), 7 * nViews);
  if (!values) return [];
  const views = Array.from({ length: nViews }, (_, ix) => {
    const own = values.slice(7 * ix, 7 * (ix + 1));
    return { position: own.slice(0, 3) as Point, target: own.slice(3, 6) as Point, fovDegrees: own[6]! };
  });
  const isValid = views.every((view) => isLookingAt(view.position, view.target) && isFov(view.fovDegrees));
  return isValid ? views : [];
}

function isLookingAt(eye: Point, target: Point): boolean {
  return Math.hypot(...eye.map((value, axis) => value - target[axis]!)) > MIN_VIEW_DISTANCE_M;
}

function isFov(degrees: number): boolean {
  return degrees >= MIN_FOV_DEGREES && degrees <= MAX_FOV_DEGREES;
}

function names(text: string): string[] {
  const all = text.split("_").slice(0, MAX_SWITCHES);
  return [...new Set(all)].filter((name) => NAME.test(name));
}

function pointOf(text: string): Point | null {
  return numbersOf(text, 3) as Point | null;
}

/** Exactly `n` numbers; null if the text has more, fewer or invalid numbers. */
function numbersOf(text: string, n: number): number[] | null {
  const words = text.split("_");
  if (words.length !== n || !words.every((word) => NUMBER.test(word))) return null;
  const values = words.map(Number);
  return values.every((value) => Math.abs(value) <= MAX_COORDINATE_M) ? values : null;
}

function numbers(values: readonly number[], decimals: number): string {
  return values.map((value) => number(value, decimals)).join("_");
}

function number(value: number, decimals: number): string {
  const text = value.toFixed(decimals).replace(/\.?0+$/, "");
  return text === "-0" ? "0" : text;
}

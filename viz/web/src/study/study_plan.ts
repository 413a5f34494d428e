// What a study consists of: conditions, tasks and statements. The default is the user study of the paper, with splats drawn directly
// as a fifth condition. A study file replaces parts of it.

import { DRAWING_MODES, type DrawingMode, NAME } from "../workspace/workspace";

/** A way to view the scene. */
export interface Condition {
  id: string;
  label: string;
  /** On which display. A headset is another device, so the experimenter chooses the view there. */
  display: "screen" | "headset";
  /** Method of the model. */
  model: string;
  mode: DrawingMode;
}

export interface Task {
  id: string;
  title: string;
  /** What the participant reads. */
  text: string;
  /** Time after which the task ends, seconds. */
  limit_s: number;
}

/** A statement that participants rate after each condition. */
export interface Statement {
  id: string;
  text: string;
}

export interface Study {
  title: string;
  conditions: Condition[];
  tasks: Task[];
  statements: Statement[];
  /** Number of points of the rating scale: 1 disagrees, the last agrees. */
  scale: number;
}

/** The four viewing modes of the paper, and splats drawn directly in the headset, which its participants wished for. */
const CONDITIONS: Condition[] = [
  { id: "mesh-headset", label: "Mesh in the headset", display: "headset", model: "tsdf", mode: "direct" },
  { id: "field-headset", label: "Radiance field in the headset, on a panel in the hand", display: "headset", model: "nerf", mode: "panel" },
  { id: "field-screen", label: "Radiance field on the screen", display: "screen", model: "nerf", mode: "pictures" },
  { id: "mesh-screen", label: "Mesh on the screen", display: "screen", model: "tsdf", mode: "direct" },
  { id: "splats-headset", label: "Splats in the headset", display: "headset", model: "splat", mode: "direct" },
];

const TASKS: Task[] = [
  { id: "perceive", title: "Perceive", text: "Find the object that the experimenter names, and read what is written on it, or describe its shape.", limit_s: 120 },
  { id: "locomote", title: "Locomote", text: "Show a way for the robot from where it stands to the place that the experimenter names, without touching anything.", limit_s: 120 },
  { id: "manipulate", title: "Manipulate", text: "Show where the gripper has to be, and from which direction it comes, to grasp the object that the experimenter names.", limit_s: 120 },
];

/** The paper compares perception, locomotion, manipulation and usability. It does not print its questions: these are ours. */
const STATEMENTS: Statement[] = [
  { id: "perception", text: "I saw the shape and the details of the scene clearly." },
  { id: "locomotion", text: "I could tell where the robot is in its surroundings, well enough to drive it." },
  { id: "manipulation", text: "I could judge where objects are, well enough to grasp them." },
  { id: "usability", text: "The view was easy to move and easy to understand." },
];

export const DEFAULT_STUDY: Study = {
  title: "Viewing modes",
  conditions: CONDITIONS,
  tasks: TASKS,
  statements: STATEMENTS,
  scale: 5,
};

const FORMAT = "fieldrig-study";
const VERSION = 1;
export const MAX_BYTES = 65_536;
const MAX_ENTRIES = 12;
const MAX_TEXT_LENGTH = 400;
const MAX_LIMIT_S = 3600;
const SCALE: readonly [number, number] = [3, 11];

/** A mistake in a study file. */
class Mistake extends Error {}

/** Reads a study file. Parts that it leaves out are those of the default. If it is none, returns the reason in one sentence. */
export function studyIn(text: string): Study | string {
  try {
    return studyOf(parsed(text));
  } catch (error) {
    if (error instanceof Mistake) return error.message;
    throw error;
  }
}

function parsed(text: string): unknown {
  if (text.length > MAX_BYTES) throw new Mistake(`it has more than ${MAX_BYTES} bytes, expected a study file`);
  try {
    return JSON.parse(text);
  } catch {
    throw new Mistake("it is not JSON, expected a study file");
  }
}

function studyOf(value: unknown): Study {
  const file = objectAt("the file", value, null);
  if (file.format !== FORMAT || file.version !== VERSION) {
    throw new Mistake(`its format and version are not "${FORMAT}" and ${VERSION}, expected a study file of this version`);
  }
  objectAt("the file", value, ["format", "version", "title", "conditions", "tasks", "statements", "scale"]);
  return {
    title: file.title === undefined ? DEFAULT_STUDY.title : textAt("title", file.title),
    conditions: file.conditions === undefined ? CONDITIONS : listAt("conditions", file.conditions, conditionAt),
    tasks: file.tasks === undefined ? TASKS : listAt("tasks", file.tasks, taskAt),
    statements: file.statements === undefined ? STATEMENTS : listAt("statements", file.statements, statementAt),
    scale: file.scale === undefined ? DEFAULT_STUDY.scale : wholeAt("scale", file.scale, ...SCALE),
  };
}

function conditionAt(path: string, value: unknown): Condition {
  const condition = objectAt(path, value, ["id", "label", "display", "model", "mode"]);
  const { display, mode } = condition;
  if (display !== "screen" && display !== "headset") throw new Mistake(`${path}.display is not screen or headset`);
  const known = DRAWING_MODES.find((name) => name === mode);
  if (!known) throw new Mistake(`${path}.mode is none of ${DRAWING_MODES.join(", ")}`);
  return { id: idAt(path, condition), label: textAt(`${path}.label`, condition.label), display, model: nameAt(`${path}.model`, condition.model), mode: known };
}

function taskAt(path: string, value: unknown): Task {
  const task = objectAt(path, value, ["id", "title", "text", "limit_s"]);
  return {
    id: idAt(path, task),
    title: textAt(`${path}.title`, task.title),
    text: textAt(`${path}.text`, task.text),
    limit_s: wholeAt(`${path}.limit_s`, task.limit_s, 1, MAX_LIMIT_S),
  };
}

function statementAt(path: string, value: unknown): Statement {
  const statement = objectAt(path, value, ["id", "text"]);
  return { id: idAt(path, statement), text: textAt(`${path}.text`, statement.text) };
}

function listAt<T extends { id: string }>(path: string, value: unknown, read: (path: string, value: unknown) => T): T[] {
  if (!Array.isArray(value) || value.length === 0 || value.length > MAX_ENTRIES) {
    throw new Mistake(`${path} is not a list of 1 to ${MAX_ENTRIES} entries`);
  }
  const entries = value.map((entry, ix) => read(`${path}[${ix}]`, entry));
  if (new Set(entries.map(({ id }) => id)).size < entries.length) throw new Mistake(`${path} has two entries with the same id`);
  return entries;
}

/** An object. Other keys than the known ones are a mistake. */
function objectAt(path: string, value: unknown, known: readonly string[] | null): Record<string, unknown> {
  if (typeof value !== "object" || value === null || Array.isArray(value)) throw new Mistake(`${path} is not an object`);
  const other = Object.keys(value).find((key) => known !== null && !known.includes(key));
  if (other !== undefined) throw new Mistake(`${path} has another key than ${known?.join(", ")}`);
  return value as Record<string, unknown>;
}

function idAt(path: string, { id }: Record<string, unknown>): string {
  return nameAt(`${path}.id`, id);
}

function nameAt(path: string, value: unknown): string {
  if (typeof value === "string" && NAME.test(value)) return value;
  throw new Mistake(`${path} is not a name of up to 32 of a-z, 0-9, - and _`);
}

function textAt(path: string, value: unknown): string {
  if (typeof value === "string" && value.trim() !== "" && value.length <= MAX_TEXT_LENGTH) return value;
  throw new Mistake(`${path} is not a text of 1 to ${MAX_TEXT_LENGTH} characters`);
}

function wholeAt(path: string, value: unknown, min: number, max: number): number {
  if (typeof value === "number" && Number.isInteger(value) && value >= min && value <= max) return value;
  throw new Mistake(`${path} is not a whole number from ${min} to ${max}`);
}

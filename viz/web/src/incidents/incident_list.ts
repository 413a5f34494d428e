// The incidents of a steered run, as in docs/reference/files.md. Positions are radians or meters, and poses x, y, z in meters
// and a quaternion x, y, z, w. This file has no DOM.

export type IncidentKind = "lease" | "stop" | "brake" | "refused" | "slowed";
export type PoseNumbers = [number, number, number, number, number, number, number];
export type Point = [number, number, number];

export interface Incident {
  /** Time since the beginning of the log. */
  seconds: number;
  kind: IncidentKind;
  text: string;
  /** In the frame of the base of the arm. */
  place: Point | null;
  operator: number | null;
  /** Joint positions; empty before the first report of the arm. */
  position: number[];
  /** The last target; null if the arm followed none. */
  target: number[] | null;
  /** What the operator saw. */
  view: PoseNumbers | null;
  /** Pose of the base, if it was steered. */
  worldFromBase: PoseNumbers | null;
}

/** Where the arm was at a time. */
export interface Sample {
  seconds: number;
  position: number[];
  target: number[] | null;
  /** Pose of the base, if it was steered. */
  worldFromBase: PoseNumbers | null;
}

export interface IncidentList {
  beganUnixMillis: number;
  /** Time from the beginning of the log to its end. */
  seconds: number;
  worldFromBase: PoseNumbers;
  jointNames: string[];
  incidents: Incident[];
  /** Where the arm was around the incidents, in the order of time. */
  track: Sample[];
  /** Number of older incidents that are left out. */
  leftOut: number;
  damage: string | null;
}

const KINDS: Record<IncidentKind, string> = {
  lease: "Control",
  stop: "Stop",
  brake: "Brake",
  refused: "Refused",
  slowed: "Slowed",
};

/** How much of the track is shown with an incident. */
const BEFORE_SECS = 2;
const AFTER_SECS = 3;

type Fields = Record<string, unknown>;

/** The list in the JSON of a server; null if a part of it is missing or damaged. */
export function parseIncidents(value: unknown): IncidentList | null {
  if (!isFields(value)) return null;
  const { began_unix_millis: beganUnixMillis, seconds, world_from_base: worldFromBase, joint_names: jointNames } = value;
  if (!isNumber(beganUnixMillis) || !isNumber(seconds) || !areNumbers(worldFromBase, 7)) return null;
  if (!Array.isArray(jointNames) || !jointNames.every(isText) || !Array.isArray(value.incidents)) return null;
  const incidents = value.incidents.map((incident) => incidentIn(incident, jointNames.length));
  if (!incidents.every((incident) => incident !== null)) return null;
  const track = Array.isArray(value.track) ? value.track.map((sample) => sampleIn(sample, jointNames.length)) : [];
  return {
    beganUnixMillis,
    seconds,
    worldFromBase: worldFromBase as PoseNumbers,
    jointNames,
    incidents,
    track: track.filter((sample) => sample !== null),
    leftOut: isNumber(value.left_out) ? value.left_out : 0,
    damage: isText(value.damage) ? value.damage : null,
  };
}

function incidentIn(value: unknown, nJoints: number): Incident | null {
  if (!isFields(value)) return null;
  const { seconds, kind, text, position, target } = value;
  if (!isNumber(seconds) || !isText(kind) || !Object.hasOwn(KINDS, kind) || !isText(text)) return null;
  if (!areNumbers(position, nJoints) && !areNumbers(position, 0)) return null;
  return {
    seconds,
    kind: kind as IncidentKind,
    text,
    place: areNumbers(value.place, 3) ? (value.place as Point) : null,
    operator: isNumber(value.operator) ? value.operator : null,
    position,
    target: areNumbers(target, nJoints) ? target : null,
    view: poseOr(value.view),
    worldFromBase: poseOr(value.world_from_base),
  };
}

function sampleIn(value: unknown, nJoints: number): Sample | null {
  if (!isFields(value)) return null;
  const { seconds, position, target } = value;
  if (!isNumber(seconds) || !areNumbers(position, nJoints)) return null;
  const worldFromBase = poseOr(value.world_from_base);
  return { seconds, position, target: areNumbers(target, nJoints) ? target : null, worldFromBase };
}

function poseOr(value: unknown): PoseNumbers | null {
  return areNumbers(value, 7) ? (value as PoseNumbers) : null;
}

/** The track around an incident, and the index of the sample that is closest to it. */
export function samplesAround({ track }: IncidentList, { seconds }: Incident): { samples: Sample[]; ix: number } {
  const samples = track.filter((sample) => sample.seconds >= seconds - BEFORE_SECS && sample.seconds <= seconds + AFTER_SECS);
  const distance = (sample: Sample | undefined): number => Math.abs((sample?.seconds ?? Infinity) - seconds);
  const ix = samples.reduce((best, sample, ix) => (distance(sample) < distance(samples[best]) ? ix : best), 0);
  return { samples, ix };
}

/** The kind as a word. Words, not only colors, distinguish the kinds. */
export function kindText(kind: IncidentKind): string {
  return KINDS[kind];
}

/** Time since the beginning of the log, such as `2:05.3`. */
export function timeText(seconds: number): string {
  const tenths = Math.round(10 * seconds);
  const minutes = Math.floor(tenths / 600);
  return `${minutes}:${((tenths % 600) / 10).toFixed(1).padStart(4, "0")}`;
}

/** Wall-clock time of an incident in UTC, such as `2026-11-30 02:14:07 UTC`. */
export function clockText(list: IncidentList, { seconds }: Incident): string {
  const time = new Date(list.beganUnixMillis + 1000 * seconds);
  return Number.isFinite(time.getTime()) ? `${time.toISOString().slice(0, 19).replace("T", " ")} UTC` : "unknown time";
}

/** How the model that is shown differs from the one at the time of an incident. */
export function modelText(list: IncidentList, { seconds }: Incident): string {
  const left = Math.max(0, list.seconds - seconds);
  return `The model is that of the end of the run: it learned for at least ${left.toFixed(1)} s more after this moment.`;
}

/** What the list lacks; empty if it is complete. */
export function lackText({ leftOut, damage }: IncidentList): string {
  const older = leftOut > 0 ? `${leftOut} older incidents are left out. ` : "";
  return `${older}${damage === null ? "" : `The rest of the log is damaged: ${damage}.`}`.trim();
}

/** The positions in the order of other names. Joints without a position are at 0. */
export function positionsFor(names: readonly string[], list: IncidentList, positions: readonly number[]): number[] {
  return names.map((name) => positions[list.jointNames.indexOf(name)] ?? 0);
}

function isFields(value: unknown): value is Fields {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}

function isNumber(value: unknown): value is number {
  return typeof value === "number" && Number.isFinite(value);
}

function isText(value: unknown): value is string {
  return typeof value === "string";
}

function areNumbers(value: unknown, n: number): value is number[] {
  return Array.isArray(value) && value.length === n && value.every(isNumber);
}

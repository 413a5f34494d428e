// The messages of the WebSocket /steer, as in docs/reference/protocol.md. Poses are x, y, z in meters and a quaternion x, y,
// z, w, in the frame of the base link of the arm. Times are microseconds on the server's clock.

/** Seven numbers of a pose. */
export type PoseNumbers = [number, number, number, number, number, number, number];
export type Point = [number, number, number];

/** Where the arm or the base should move. */
export type Intent =
  | { kind: "hand"; base_from_hand: PoseNumbers }
  | { kind: "pose"; base_from_tip: PoseNumbers }
  | { kind: "joints"; position: number[] }
  | { kind: "joint_velocity"; velocity: number[] }
  | { kind: "tip_velocity"; linear_m_s: Point; angular_rad_s: Point }
  | { kind: "base_velocity"; forward_m_s: number; left_m_s: number; yaw_rad_s: number }
  | { kind: "base_goal"; x_m: number; y_m: number; heading_rad: number };

/** A pose of the tip, or positions of the joints. */
export type PreviewTarget = { base_from_tip: PoseNumbers } | { position: number[] };

export type SteerRequest =
  | { type: "lease"; action: "take" | "renew" | "release" }
  | { type: "lease"; action: "offer"; to: number }
  | { type: "stop" }
  | { type: "rearm"; stop: number }
  | {
      type: "command";
      device: number;
      sequence: number;
      captured_micros: number;
      /** How often the dead-man switch has been closed; null while it is open. */
      grip: number | null;
      intent?: Intent;
    }
  | ({ type: "preview"; id: number } & PreviewTarget)
  | { type: "view"; world_from_camera: PoseNumbers }
  | { type: "ping"; id: number };

export interface ArmJoint {
  name: string;
  /** Radians or meters; null without limit. */
  lower: number | null;
  upper: number | null;
  is_prismatic: boolean;
  /** Greatest speed, radians or meters per second. */
  velocity: number;
}

/** A base that is driven. */
export interface SteeredBase {
  /** Largest speeds, m/s and rad/s. `max_left_m_s` is 0 for a base that cannot move sideways. */
  max_forward_m_s: number;
  max_left_m_s: number;
  max_yaw_rad_s: number;
  /** Where it stays: smallest x and y, then largest x and y, in the world, meters. */
  area_m: Area | null;
  /** What keeps the base away from obstacles. */
  avoidance: Avoidance;
  /** Joint values of the arm while the base moves; null without an arm. */
  stowed: number[] | null;
}

export type Avoidance = "nothing" | "seen_surfaces" | "unknown_space";
/** A part of the robot that an operator moves. */
export type Part = "arm" | "base";

export type Area = [number, number, number, number];

/** First message: the arm or the base, and what this client may do. */
export interface Arm {
  type: "arm";
  client: number;
  may_steer: boolean;
  base_link: string;
  tip_link: string;
  joints: ArmJoint[];
  /** Silence of a device after which the arm brakes. */
  expiry_secs: number;
  lease_secs: number;
  /** Greatest round-trip time at which the arm follows the hand. */
  servo_round_trip_millis: number;
  /** The base, if it is steered. Without a steered arm, there are no joints. */
  base: SteeredBase | null;
}

/** A limit that was applied. */
export interface Limit {
  /** The part that is limited. Places are in the frame of the arm's base, and in the world for limits of the base. */
  part: Part;
  link: string;
  effect: "slowed" | "refused" | "braked";
  /** Speed that is left, 0 to 1. */
  speed_scale: number;
  text: string;
  place: Point | null;
}

/** The newest command that has reached the joints. */
export interface Applied {
  device: number;
  sequence: number;
  captured_micros: number;
  applied_micros: number;
}

/** A connection of `/steer`. */
export interface SteerClient {
  id: number;
  role: string;
}

/** State of a base. Places are x and y in meters and the heading in radians, in the world. */
export interface BaseState {
  world_from_base: Point | null;
  goal: Point | null;
  has_arrived: boolean;
  is_moving: boolean;
}

export interface SteerState {
  type: "state";
  time_micros: number;
  /** Client that has control. */
  holder: number | null;
  lease_left_secs: number | null;
  offered_to: number | null;
  /** Why the arm stays at rest until an operator permits motion. */
  stop: string | null;
  /** Number of the newest stop, which a permission names; null without a stop. */
  stop_number: number | null;
  /** Whether the arm is being enabled after a fault. Motion is permitted afterward, unless somebody stops the arm. */
  is_recovering: boolean;
  is_moving: boolean;
  /** The part that the operator moves; null while no dead-man switch is held. */
  moved_part: Part | null;
  position: number[];
  target: number[] | null;
  base_from_tip: PoseNumbers;
  base_from_target: PoseNumbers | null;
  limits: Limit[];
  applied: Applied | null;
  /** Contacts of the robot with a simulated scene. */
  contacts: number | null;
  /** The base, if it is steered. */
  base: BaseState | null;
  clients: SteerClient[];
}

export interface Refused {
  type: "refused";
  request: string;
  text: string;
}

export type Verdict = "reachable" | "unreachable" | "self-collision" | "near" | "never seen" | "limits";
const VERDICTS: readonly string[] = ["reachable", "unreachable", "self-collision", "near", "never seen", "limits"];

export interface PreviewAnswer {
  type: "preview";
  id: number;
  verdict: Verdict;
  text: string;
  /** Joint positions at the goal. */
  position: number[] | null;
  place: Point | null;
}

export interface Pong {
  type: "pong";
  id: number;
  time_micros: number;
}

export type SteerMessage = Arm | SteerState | Refused | PreviewAnswer | Pong;

type Fields = Record<string, unknown>;

/** The message in a text; null if it is damaged or of an unknown kind. A wrong number must never reach a gizmo or a command. */
export function parseMessage(text: string): SteerMessage | null {
  let fields: unknown;
  try {
    fields = JSON.parse(text);
  } catch {
    return null;
  }
  if (!isFields(fields)) return null;
  switch (fields.type) {
    case "arm":
      return armIn(fields);
    case "state":
      return stateIn(fields);
    case "refused":
      return isText(fields.request) && isText(fields.text) ? { type: "refused", request: fields.request, text: fields.text } : null;
    case "preview":
      return previewIn(fields);
    case "pong":
      return isNumber(fields.id) && isNumber(fields.time_micros)
        ? { type: "pong", id: fields.id, time_micros: fields.time_micros }
        : null;
    default:
      return null;
  }
}

function armIn({ client, may_steer, base_link, tip_link, joints, expiry_secs, lease_secs, ...fields }: Fields): Arm | null {
  const { servo_round_trip_millis } = fields;
  if (!isNumber(client) || !isText(base_link) || !isText(tip_link) || !Array.isArray(joints)) return null;
  if (!isNumber(expiry_secs) || !isNumber(lease_secs) || !isNumber(servo_round_trip_millis)) return null;
  const read = joints.map(jointIn).filter((joint) => joint !== null);
  const base = baseIn(fields.base);
  if (read.length !== joints.length || (read.length === 0 && !base)) return null;
  const common = { base_link, tip_link, expiry_secs, lease_secs, servo_round_trip_millis };
  return { type: "arm", client, may_steer: may_steer === true, joints: read, base, ...common };
}

function baseIn(value: unknown): SteeredBase | null {
  if (!isFields(value)) return null;
  const { max_forward_m_s, max_left_m_s, max_yaw_rad_s, area_m } = value;
  if (!isNumber(max_forward_m_s) || !isNumber(max_left_m_s) || !isNumber(max_yaw_rad_s)) return null;
  const area = areNumbers(area_m) && area_m.length === 4 ? (area_m as Area) : null;
  // A page that does not know what keeps the base away must not promise anything.
  const avoidance = value.avoidance === "seen_surfaces" || value.avoidance === "unknown_space" ? value.avoidance : "nothing";
  const stowed = areNumbers(value.stowed) ? value.stowed : null;
  return { max_forward_m_s, max_left_m_s, max_yaw_rad_s, area_m: area, avoidance, stowed };
}

function baseStateIn(value: unknown): BaseState | null {
  if (!isFields(value)) return null;
  const places = { world_from_base: pointOr(value.world_from_base), goal: pointOr(value.goal) };
  return { ...places, has_arrived: value.has_arrived === true, is_moving: value.is_moving === true };
}

function jointIn(value: unknown): ArmJoint | null {
  if (!isFields(value) || !isText(value.name) || !isNumber(value.velocity)) return null;
  const { name, velocity, is_prismatic } = value;
  return { name, velocity, is_prismatic: is_prismatic === true, lower: numberOr(value.lower), upper: numberOr(value.upper) };
}

function stateIn(fields: Fields): SteerState | null {
  const { time_micros, position, base_from_tip } = fields;
  if (!isNumber(time_micros) || !areNumbers(position) || !isPose(base_from_tip)) return null;
  return {
    type: "state",
    time_micros,
    holder: numberOr(fields.holder),
    lease_left_secs: numberOr(fields.lease_left_secs),
    offered_to: numberOr(fields.offered_to),
    stop: isText(fields.stop) ? fields.stop : null,
    stop_number: numberOr(fields.stop_number),
    is_recovering: fields.is_recovering === true,
    is_moving: fields.is_moving === true,
    moved_part: fields.moved_part === "arm" || fields.moved_part === "base" ? fields.moved_part : null,
    position,
    target: areNumbers(fields.target) && fields.target.length === position.length ? fields.target : null,
    base_from_tip,
    base_from_target: isPose(fields.base_from_target) ? fields.base_from_target : null,
    limits: listOf(fields.limits, limitIn),
    applied: appliedIn(fields.applied),
    contacts: numberOr(fields.contacts),
    base: baseStateIn(fields.base),
    clients: listOf(fields.clients, clientIn),
  };
}

function limitIn(value: unknown): Limit | null {
  if (!isFields(value) || !isText(value.link) || !isText(value.text)) return null;
  const { link, text, effect } = value;
  if (effect !== "slowed" && effect !== "refused" && effect !== "braked") return null;
  const part = value.part === "base" ? "base" : "arm";
  return { part, link, effect, text, speed_scale: numberOr(value.speed_scale) ?? 0, place: pointOr(value.place) };
}

function appliedIn(value: unknown): Applied | null {
  if (!isFields(value)) return null;
  const { device, sequence, captured_micros, applied_micros } = value;
  if (!isNumber(device) || !isNumber(sequence) || !isNumber(captured_micros) || !isNumber(applied_micros)) return null;
  return { device, sequence, captured_micros, applied_micros };
}

function clientIn(value: unknown): SteerClient | null {
  return isFields(value) && isNumber(value.id) && isText(value.role) ? { id: value.id, role: value.role } : null;
}

function previewIn({ id, verdict, text, position, place }: Fields): PreviewAnswer | null {
  if (!isNumber(id) || !isText(verdict) || !VERDICTS.includes(verdict) || !isText(text)) return null;
  const joints = areNumbers(position) ? position : null;
  return { type: "preview", id, verdict: verdict as Verdict, text, position: joints, place: pointOr(place) };
}

function listOf<T>(value: unknown, read: (entry: unknown) => T | null): T[] {
  return Array.isArray(value) ? value.map(read).filter((entry) => entry !== null) : [];
}

function isFields(value: unknown): value is Fields {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}

function isText(value: unknown): value is string {
  return typeof value === "string";
}

function isNumber(value: unknown): value is number {
  return typeof value === "number" && Number.isFinite(value);
}

function areNumbers(value: unknown): value is number[] {
  return Array.isArray(value) && value.every(isNumber);
}

function isPose(value: unknown): value is PoseNumbers {
  return areNumbers(value) && value.length === 7;
}

function numberOr(value: unknown): number | null {
  return isNumber(value) ? value : null;
}

function pointOr(value: unknown): Point | null {
  return areNumbers(value) && value.length === 3 ? (value as Point) : null;
}

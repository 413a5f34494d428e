// Poses of the arm that the user has named, as text for the storage of the browser. This file has no DOM.

export const MAX_NAME_LENGTH = 60;
/** Browsers store only a few megabytes for a page. */
export const MAX_POSES = 100;

export interface StoredPose {
  name: string;
  /** Radians or meters, by the name of the joint, because another robot can have the same number of joints. */
  joints: Record<string, number>;
}

/** Reads a stored list. Leaves out entries that are damaged. */
export function storedPosesIn(text: string | null): StoredPose[] {
  let list: unknown;
  try {
    list = JSON.parse(text ?? "[]");
  } catch {
    return [];
  }
  if (!Array.isArray(list)) return [];
  return list.filter(isStoredPose).slice(0, MAX_POSES).map(({ name, joints }) => ({ name, joints }));
}

/** The list with this pose; one of the same name is replaced. Null if the list is full. */
export function withPose(poses: readonly StoredPose[], pose: StoredPose): StoredPose[] | null {
  const name = tidied(pose.name);
  const named = { name: name === "" ? freePoseName(poses) : name, joints: pose.joints };
  if (poses.some((other) => other.name === named.name)) {
    return poses.map((other) => (other.name === named.name ? named : other));
  }
  return poses.length < MAX_POSES ? [...poses, named] : null;
}

/** A name that no pose has. */
export function freePoseName(poses: readonly StoredPose[]): string {
  let n = poses.length + 1;
  while (poses.some(({ name }) => name === `Pose ${n}`)) n += 1;
  return `Pose ${n}`;
}

/** Positions in the order of the joints; null if the pose belongs to another arm. */
export function positionsFor({ joints }: StoredPose, names: readonly string[]): number[] | null {
  const positions = names.map((name) => (Object.hasOwn(joints, name) ? joints[name]! : Number.NaN));
  return Object.keys(joints).length === names.length && positions.every(Number.isFinite) ? positions : null;
}

function tidied(name: string): string {
  return name.trim().slice(0, MAX_NAME_LENGTH);
}

function isStoredPose(value: unknown): value is StoredPose {
  const { name, joints } = (value ?? {}) as Partial<Record<keyof StoredPose, unknown>>;
  if (typeof name !== "string" || tidied(name) !== name || name === "") return false;
  if (typeof joints !== "object" || joints === null || Array.isArray(joints)) return false;
  const positions = Object.values(joints);
  return positions.length > 0 && positions.every((position) => Number.isFinite(position));
}

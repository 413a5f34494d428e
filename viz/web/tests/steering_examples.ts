// An arm with two joints and its state, for tests of steering.

import type { Arm, SteerState } from "../src/steering/messages";

export const CLIENT = 7;

export const ARM: Arm = {
  type: "arm",
  client: CLIENT,
  may_steer: true,
  base_link: "base",
  tip_link: "tip",
  joints: [
    { name: "shoulder", lower: -1, upper: 1, is_prismatic: false, velocity: 2 },
    { name: "slide", lower: null, upper: 0.5, is_prismatic: true, velocity: 1 },
  ],
  expiry_secs: 0.12,
  lease_secs: 5,
  servo_round_trip_millis: 100,
  base: null,
};

/** A base that cannot move sideways. */
export const BASE: Arm = {
  ...ARM,
  joints: [],
  base: { max_forward_m_s: 0.5, max_left_m_s: 0, max_yaw_rad_s: 1, area_m: [-1, -1, 1, 1], avoidance: "unknown_space", stowed: null },
};

/** The arm of [`ARM`] on a base that can move sideways. */
export const BOTH: Arm = {
  ...ARM,
  base: { max_forward_m_s: 0.5, max_left_m_s: 0.3, max_yaw_rad_s: 1, area_m: null, avoidance: "seen_surfaces", stowed: [0, 0.1] },
};

/** This client has control, and the arm is at rest. */
export const STATE: SteerState = {
  type: "state",
  time_micros: 1e6,
  holder: CLIENT,
  lease_left_secs: 5,
  offered_to: null,
  stop: null,
  stop_number: null,
  is_recovering: false,
  is_moving: false,
  moved_part: null,
  position: [0.1, 0.2],
  target: null,
  base_from_tip: [0.5, 0, 0.4, 0, 0, 0, 1],
  base_from_target: null,
  limits: [],
  applied: null,
  contacts: 0,
  base: null,
  clients: [{ id: CLIENT, role: "operator" }],
};

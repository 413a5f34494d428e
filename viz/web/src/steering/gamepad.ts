// What the buttons and sticks of a gamepad mean. The numbers are those of the "standard" layout of the Gamepad API
// (W3C, https://www.w3.org/TR/gamepad/#remapping). This file has no DOM.

import type { Deflection } from "./jog";

/** Sticks do not return to exactly zero. */
const DEAD_ZONE = 0.12;
/** A trigger that is pulled beyond this holds the dead-man switch. */
const PULLED = 0.5;

const SOUTH = 0;
const EAST = 1;
/** Y on most gamepads. */
const NORTH = 3;
const [LEFT_SHOULDER, RIGHT_SHOULDER] = [4, 5];
const TRIGGERS = [6, 7];
const [DPAD_UP, DPAD_DOWN] = [12, 13];

/** The part of a `Gamepad` that is read. */
export interface PadState {
  mapping: string;
  axes: readonly number[];
  buttons: readonly { pressed: boolean; value: number }[];
}

export interface PadInput {
  /** Whether a trigger is held. */
  isHeld: boolean;
  /** Whether the button "go" is held besides. */
  isGo: boolean;
  isStop: boolean;
  /** Whether the button is down that switches between arm and base. */
  isSwitch: boolean;
  deflection: Deflection;
}

/** What the operator does with the gamepad; null if its layout is unknown, because a wrong button could move the arm. */
export function padInput({ mapping, axes, buttons }: PadState): PadInput | null {
  if (mapping !== "standard") return null;
  const isPressed = (ix: number): boolean => buttons[ix]?.pressed === true;
  const difference = (plus: number, minus: number): number => Number(isPressed(plus)) - Number(isPressed(minus));
  const [leftX, leftY, rightX, rightY] = [0, 1, 2, 3].map((ix) => withoutDeadZone(axes[ix] ?? 0)) as [number, number, number, number];
  const isHeld = TRIGGERS.some((ix) => (buttons[ix]?.value ?? 0) > PULLED);
  return {
    isHeld,
    isGo: isHeld && isPressed(SOUTH),
    isStop: isPressed(EAST),
    isSwitch: isPressed(NORTH),
    deflection: {
      right: leftX,
      forward: negated(leftY), // Sticks are positive toward the operator.
      up: difference(DPAD_UP, DPAD_DOWN),
      pitch: negated(rightY),
      roll: difference(RIGHT_SHOULDER, LEFT_SHOULDER),
      yaw: negated(rightX),
    },
  };
}

/** What the first gamepad reports whose layout is known, and its place in the list. The stop button of each gamepad counts. */
export function firstPad(pads: readonly (PadState | null)[]): { ix: number; input: PadInput } | null {
  const inputs = pads.map((pad) => pad && padInput(pad));
  const ix = inputs.findIndex((input) => input !== null);
  const input = inputs[ix];
  return input ? { ix, input: { ...input, isStop: inputs.some((other) => other?.isStop === true) } } : null;
}

/** The deflection beyond the dead zone, from -1 to 1, without a step at its border. */
export function withoutDeadZone(value: number): number {
  const beyond = Math.min(1, Math.abs(value)) - DEAD_ZONE;
  // Written so that NaN becomes zero.
  return beyond > 0 ? (Math.sign(value) * beyond) / (1 - DEAD_ZONE) : 0;
}

function negated(value: number): number {
  return value === 0 ? 0 : -value;
}

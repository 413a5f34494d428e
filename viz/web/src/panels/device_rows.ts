// What the list of devices of a preview says. Pure, so that it can be tested without a page.

import type { DeviceStatus } from "../connection/protocol";
import { capitalized } from "./sentence";

/** How a row is colored. */
export type RowKind = "waiting" | "live" | "slow" | "bad";

export interface DeviceRow {
  name: string;
  kind: RowKind;
  /** Rate and age, or the state. */
  value: string;
  /** Why there is no data, as a sentence; empty if there is. */
  reason: string;
}

/** A device is slow if its rate is below this part of the rate in the rig file. The terminal warns at the same part. */
const MIN_RATE_PART = 0.95;
/** Ages up to this are in milliseconds. */
const MAX_MILLIS = 10_000;

export function deviceRow({ name, state, rate_hz, expected_hz, age_millis, reason }: DeviceStatus): DeviceRow {
  const row = { name: capitalized(name), reason: capitalized(reason) };
  switch (state) {
    case "opening":
      return { ...row, kind: "waiting", value: "opening" };
    case "delivering": {
      const isSlow = rate_hz !== null && expected_hz !== null && rate_hz < MIN_RATE_PART * expected_hz;
      const parts = [rate_hz === null ? "" : rateText(rate_hz, isSlow ? expected_hz : null), ageText(age_millis)];
      return { ...row, kind: isSlow ? "slow" : "live", value: parts.filter((part) => part !== "").join(", ") };
    }
    case "silent":
      return { ...row, kind: "bad", value: "silent" };
    case "failed":
      return { ...row, kind: "bad", value: "not open, trying again" };
    case "ended":
      return { ...row, kind: "waiting", value: "ended" };
    default:
      return { ...row, kind: "waiting", value: state }; // A newer server may have more states.
  }
}

/** The text of a caption: the devices that deliver, of all. */
export function devicesTitle(devices: readonly DeviceStatus[]): string {
  const n = devices.filter(({ state }) => state === "delivering").length;
  return n === devices.length ? "Devices" : `Devices: ${n} of ${devices.length} deliver data`;
}

function rateText(hz: number, expectedHz: number | null): string {
  const digits = (value: number): string => value.toFixed(value < 100 ? 1 : 0);
  return expectedHz === null ? `${digits(hz)} Hz` : `${digits(hz)} of ${digits(expectedHz)} Hz`;
}

function ageText(millis: number | null): string {
  if (millis === null) return "";
  return millis < MAX_MILLIS ? `${Math.round(millis)} ms old` : `${Math.round(millis / 1000)} s old`;
}

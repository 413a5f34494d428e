import assert from "node:assert/strict";
import { test } from "node:test";
import type { DeviceStatus } from "../src/connection/protocol";
import { deviceRow, devicesTitle } from "../src/panels/device_rows";

const CAMERA: DeviceStatus = {
  name: 'camera "front"',
  state: "delivering",
  rate_hz: 29.97,
  expected_hz: 30,
  age_millis: 34.6,
  reason: "",
};

test("a device that delivers has a rate and an age", () => {
  assert.deepEqual(deviceRow(CAMERA), { name: 'Camera "front"', kind: "live", value: "30.0 Hz, 35 ms old", reason: "" });
  const arm = { ...CAMERA, name: "arm", rate_hz: 999.6, expected_hz: null, age_millis: 1.2 };
  assert.equal(deviceRow(arm).value, "1000 Hz, 1 ms old");
  assert.equal(deviceRow({ ...CAMERA, rate_hz: null, age_millis: 12_400 }).value, "12 s old");
});

test("a device that is slower than in the rig file is marked", () => {
  const { kind, value } = deviceRow({ ...CAMERA, rate_hz: 15 });
  assert.deepEqual([kind, value], ["slow", "15.0 of 30.0 Hz, 35 ms old"]);
});

test("a device without data has a reason", () => {
  const failed = deviceRow({ ...CAMERA, state: "failed", rate_hz: null, reason: "no V4L2 camera is connected" });
  assert.deepEqual([failed.kind, failed.value, failed.reason], ["bad", "not open, trying again", "No V4L2 camera is connected"]);
  assert.equal(deviceRow({ ...CAMERA, state: "silent", reason: "no data for 3 s" }).value, "silent");
  assert.equal(deviceRow({ ...CAMERA, state: "opening" }).kind, "waiting");
  const newer = { ...CAMERA, state: "warming up" } as unknown as DeviceStatus;
  assert.equal(deviceRow(newer).value, "warming up");
});

test("the title counts the devices that deliver", () => {
  assert.equal(devicesTitle([CAMERA, CAMERA]), "Devices");
  assert.equal(devicesTitle([CAMERA, { ...CAMERA, state: "failed" }]), "Devices: 1 of 2 deliver data");
});

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import {
  DRAWING_MODES,
  FORMAT,
  FOV_DEGREES,
  FRAME,
  MAX_BYTES,
  MAX_COORDINATE_M,
  MAX_NAMES,
  MAX_PATH_VIEWS,
  NAME,
  VERSION,
  VIEW_MODES,
  type Workspace,
  workspaceIn,
  workspaceText,
} from "../src/workspace/workspace";

/** Files that the unit tests of the server read, too, relative to viz/web, where npm runs the tests. */
const CASES = "../tests/workspaces.json";
const SCHEMA = "../../docs/reference/workspace.schema.json";

interface Case {
  name: string;
  file?: unknown;
  text?: string;
  /** A part of the sentence; null if the file is valid. */
  problem: string | null;
}
const cases = JSON.parse(readFileSync(CASES, "utf8")) as Case[];
// biome-ignore lint/suspicious/noExplicitAny: a schema has nested parts of many kinds.
const schema = JSON.parse(readFileSync(SCHEMA, "utf8")) as any;

const ALL: Workspace = {
  camera: { mode: "chase", position_m: [1.25, -0.5, 12], target_m: [0, 0.25, -4], up: [0, 0, 1], fov_degrees: 50, attached_to: "tool0" },
  crop: { is_on: true, box: { center_m: [-1, -2, 0.25], size_m: [2, 4, 6.5], yaw_rad: -0.5 } },
  layers: { model: true, grid: false },
  panels: { side: true, open: "layers", docked_cameras: ["wrist"] },
  model: "splat",
  mode: "direct",
  path: [{ position_m: [1, 2, 3], target_m: [0, 0, 0], fov_degrees: 40.5 }],
};

test("a saved workspace is read again, and starts with its format and version", () => {
  const text = workspaceText(ALL);
  assert.deepEqual(workspaceIn(text), ALL);
  assert.ok(text.startsWith(`{\n  "format": "${FORMAT}",\n  "version": ${VERSION},`), text);
  assert.ok(text.endsWith("}\n"));
  assert.deepEqual(workspaceIn(workspaceText({})), {});
});

test("valid files are read, and others give one sentence that names the mistake", () => {
  assert.ok(cases.length > 30);
  for (const { name, file, text, problem } of cases) {
    const read = workspaceIn(text ?? JSON.stringify(file));
    if (problem === null) {
      assert.equal(typeof read, "object", `${name}: ${String(read)}`);
      continue;
    }
    assert.ok(typeof read === "string" && read.includes(problem), `${name}: ${String(read)}`);
    assert.ok(!/[\n<>]|\. /.test(read.replace(/"[^"]*"/g, "")) && read.length < 240, `${name}: ${read}`);
  }
});

test("long files are refused without being parsed", () => {
  const long = `{"format": "${FORMAT}", "version": 1}${" ".repeat(MAX_BYTES)}`;
  assert.match(workspaceIn(long) as string, /more than 65536 bytes/);
});

test("a workspace cannot change the prototype of objects", () => {
  const read = workspaceIn(`{"format": "${FORMAT}", "version": 1, "layers": {"__proto__": true, "grid": true}}`);
  assert.ok(typeof read === "object");
  assert.equal(({} as Record<string, unknown>).grid, undefined);
  assert.equal(Object.getPrototypeOf(read.layers), Object.prototype);
});

test("the schema has the keys, names and ranges of the reader", () => {
  const { properties, $defs } = schema;
  // Every key of the schema occurs in a workspace that the reader accepts, and no other.
  const keysOf = (value: object): string[] => Object.keys(value).sort();
  assert.deepEqual(keysOf(properties), keysOf({ format: 0, version: 0, ...ALL }));
  assert.deepEqual(keysOf(properties.camera.properties), keysOf(ALL.camera!));
  assert.deepEqual(keysOf(properties.crop.properties), keysOf(ALL.crop!));
  assert.deepEqual(keysOf(properties.crop.properties.box.properties), keysOf(ALL.crop!.box!));
  assert.deepEqual(keysOf(properties.panels.properties), keysOf(ALL.panels!));
  assert.deepEqual(keysOf(properties.path.items.properties), keysOf(ALL.path![0]!));
  assert.deepEqual(properties.camera.properties.mode.enum, VIEW_MODES);
  assert.deepEqual(properties.mode.enum, DRAWING_MODES);
  assert.deepEqual([properties.format.const, properties.version.const], [FORMAT, VERSION]);
  assert.deepEqual([$defs.fov_degrees.minimum, $defs.fov_degrees.maximum], FOV_DEGREES);
  assert.deepEqual([$defs.point.items.minimum, $defs.point.items.maximum], [-MAX_COORDINATE_M, MAX_COORDINATE_M]);
  assert.deepEqual([$defs.name.pattern, $defs.frame.pattern], [NAME.source, FRAME.source]);
  assert.equal(properties.path.maxItems, MAX_PATH_VIEWS);
  assert.deepEqual([properties.layers.maxProperties, properties.panels.properties.docked_cameras.maxItems], [MAX_NAMES, MAX_NAMES]);
});

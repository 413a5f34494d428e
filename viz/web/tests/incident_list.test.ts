import assert from "node:assert/strict";
import { test } from "node:test";
import {
  clockText,
  kindText,
  lackText,
  modelText,
  parseIncidents,
  positionsFor,
  samplesAround,
  timeText,
} from "../src/incidents/incident_list";

/** As `steering_log::incidents` writes it. */
const LIST = {
  program: "fieldrig 0.1.0 x86_64",
  began_unix_millis: 1_795_000_000_000,
  seconds: 90.5,
  world_from_base: [1, 0, 0, 0, 0, 0, 1],
  joint_names: ["j1", "j2"],
  incidents: [
    { seconds: 0, kind: "lease", text: "operator 1 took control", place: null, operator: 1, position: [], target: null, view: null },
    {
      seconds: 65.25,
      kind: "refused",
      text: "refused: hand is 19 mm from a surface",
      place: [0.1, 0.2, 0.3],
      operator: 1,
      position: [0.5, -0.5],
      target: [0.6, -0.4],
      view: [0, 0, 1, 0, 0, 0, 1],
    },
  ],
  left_out: 0,
  damage: null,
};

test("a list is read with its postures and places", () => {
  const list = parseIncidents(JSON.parse(JSON.stringify(LIST)))!;
  const [first, second] = list.incidents;
  assert.equal(list.incidents.length, 2);
  assert.deepEqual(first!.position, []);
  assert.deepEqual([second!.place, second!.target], [[0.1, 0.2, 0.3], [0.6, -0.4]]);
  assert.equal(kindText(second!.kind), "Refused");
  assert.equal(clockText(list, second!), "2026-11-18 11:07:45 UTC");
  assert.match(modelText(list, second!), /end of the run.* 25\.3 s more/);
  assert.equal(lackText(list), "");
});

test("the robot of a steered base has its own pose at each time", () => {
  const pose = [1, 2, 0.5, 0, 0, 0, 1];
  const incidents = [{ ...LIST.incidents[0], world_from_base: pose }];
  const track = [{ seconds: 1, position: [], target: null, world_from_base: pose }];
  const list = parseIncidents({ ...LIST, joint_names: [], incidents, track })!;
  assert.deepEqual([list.incidents[0]!.worldFromBase, list.track[0]!.worldFromBase], [pose, pose]);
  assert.equal(parseIncidents(LIST)!.incidents[0]!.worldFromBase, null);
});

test("joints are found by their names, in any order", () => {
  const list = parseIncidents(LIST)!;
  assert.deepEqual(positionsFor(["finger", "j2", "j1"], list, [0.5, -0.5]), [0, -0.5, 0.5]);
});

test("the seconds around an incident are found in the track", () => {
  const at = (seconds: number) => ({ seconds, position: [seconds, 0], target: null });
  const track = [at(1), at(63.2), at(63.3), at(65.2), at(65.4), at(68.2), at(68.3), { seconds: 69, position: [1] }];
  const list = parseIncidents({ ...LIST, track })!;
  assert.equal(list.track.length, 7, "the damaged sample is left out");
  const { samples, ix } = samplesAround(list, list.incidents[1]!);
  assert.deepEqual([samples.map(({ seconds }) => seconds), ix], [[63.3, 65.2, 65.4, 68.2], 1]);
  assert.deepEqual(samplesAround(parseIncidents(LIST)!, list.incidents[1]!), { samples: [], ix: 0 });
});

test("lists with missing, wrong or non-finite parts are refused", () => {
  const [, incident] = LIST.incidents;
  for (const damaged of [
    null,
    [],
    "text",
    { ...LIST, incidents: undefined },
    { ...LIST, world_from_base: [1, 2] },
    { ...LIST, joint_names: [1] },
    { ...LIST, seconds: null },
    { ...LIST, incidents: [{ ...incident, position: [1, 2, 3] }] },
    { ...LIST, incidents: [{ ...incident, position: [1, null] }] },
    { ...LIST, incidents: [{ ...incident, kind: "toString" }] },
    { ...LIST, incidents: [{ ...incident, text: 5 }] },
  ]) {
    assert.equal(parseIncidents(damaged), null, JSON.stringify(damaged));
  }
  const odd = parseIncidents({ ...LIST, incidents: [{ ...incident, place: [1, 2], target: [1], view: "here" }] })!;
  assert.deepEqual([odd.incidents[0]!.place, odd.incidents[0]!.target, odd.incidents[0]!.view], [null, null, null]);
});

test("times and gaps are texts", () => {
  assert.deepEqual([0, 59.96, 65.25, 3601].map(timeText), ["0:00.0", "1:00.0", "1:05.3", "60:01.0"]);
  const list = { ...parseIncidents(LIST)!, leftOut: 12, damage: "corrupt gzip stream" };
  assert.equal(lackText(list), "12 older incidents are left out. The rest of the log is damaged: corrupt gzip stream.");
});

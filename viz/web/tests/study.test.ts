import assert from "node:assert/strict";
import { test } from "node:test";
import { boxOf, boxPlot } from "../src/study/box_plot";
import { balancedOrder, nOrders, taskOrder } from "../src/study/order";
import { DEFAULT_STUDY, type Study, studyIn } from "../src/study/study_plan";
import { csv, durationGroups, ratingGroups } from "../src/study/study_results";
import { type Recorded, StudySession } from "../src/study/study_session";

test("conditions are balanced by place and by predecessor", () => {
  for (const n of [1, 2, 3, 4, 5, 6, 7]) {
    const orders = Array.from({ length: nOrders(n) }, (_, participant) => balancedOrder(n, participant));
    const places = new Map<string, number>();
    const pairs = new Map<string, number>();
    const add = (counts: Map<string, number>, key: string): void => void counts.set(key, (counts.get(key) ?? 0) + 1);
    for (const order of orders) {
      assert.deepEqual([...order].sort(), Array.from({ length: n }, (_, ix) => ix), `${n}: ${order.join()}`);
      for (const [place, condition] of order.entries()) {
        add(places, `${place} ${condition}`);
        if (place > 0) add(pairs, `${order[place - 1]} ${condition}`);
      }
    }
    const repeats = nOrders(n) / n;
    assert.equal(places.size, n * n);
    assert.ok([...places.values()].every((count) => count === repeats), `${n}: places`);
    assert.equal(pairs.size, n * (n - 1));
    assert.ok([...pairs.values()].every((count) => count === repeats), `${n}: pairs`);
    // Orders repeat after that.
    assert.deepEqual(balancedOrder(n, nOrders(n)), orders[0]);
  }
  assert.deepEqual([0, 1, 2].map((place) => taskOrder(3, 0, place)[0]), [0, 1, 2]);
});

/** A participant whose answers follow from the condition and the number of the participant. */
function participate(study: Study, participant: number): readonly Recorded[] {
  const session = new StudySession(study, participant);
  for (;;) {
    const { step } = session;
    if (step.kind === "background") session.background({ age: "26", gender: "", note: '=SUM(A1), "quoted"' });
    else if (step.kind === "condition") session.begin();
    else if (step.kind === "task") {
      const secs = 10 * step.place + participant + 0.123;
      const isLast = step.taskPlace === 3 && participant % 4 === 0;
      session.endTask(isLast ? 1e4 : secs, isLast ? "out of time" : "done");
    } else if (step.kind === "rating") {
      const isSplats = step.condition.id.startsWith("splats");
      session.rate(Object.fromEntries(study.statements.map(({ id }) => [id, isSplats ? 5 : 1 + ((participant + step.place) % 4)])));
    } else if (step.kind === "preference") session.prefer("splats-headset");
    else return session.recorded;
  }
}

test("5 conditions with 3 tasks give one line per task and per rating", () => {
  const recorded = participate(DEFAULT_STUDY, 7);
  const lines = csv(recorded).trimEnd().split("\r\n");
  assert.equal(lines[0], "participant,kind,place,condition,item,value,outcome");
  const ofKind = (kind: string): string[] => lines.filter((line) => line.split(",")[1] === kind);
  assert.deepEqual([ofKind("background").length, ofKind("task").length, ofKind("rating").length, ofKind("preference").length], [2, 15, 20, 1]);
  assert.ok(ofKind("task")[0]!.match(/^7,task,1,[a-z]+-(screen|headset),(perceive|locomote|manipulate),17\.12,done$/), ofKind("task")[0]);
  // Spreadsheets do not run the text, and its quotes and commas stay in one cell.
  assert.ok(lines.includes(`7,background,,,note,"'=SUM(A1), ""quoted""",`), lines.slice(0, 4).join("\n"));
  const first = balancedOrder(5, 6).map((ix) => DEFAULT_STUDY.conditions[ix]!.id);
  const seen = [...new Set(ofKind("rating").map((line) => line.split(",")[3]))];
  assert.deepEqual(seen, first, "the conditions are in the order of the participant");
});

test("a session continues after a reload, and steps cannot be left out", () => {
  const session = new StudySession(DEFAULT_STUDY, 2);
  assert.throws(() => session.begin(), /the step is background/);
  session.background({});
  session.begin();
  session.endTask(3, "given up");
  const restored = StudySession.restored(DEFAULT_STUDY, structuredClone(session.saved));
  assert.ok(restored);
  assert.deepEqual([restored.step, restored.recorded], [session.step, session.recorded]);
  assert.throws(() => restored.endTask(Number.NaN, "done"), /a task of NaN s/);
  restored.endTask(4, "done");
  restored.endTask(5, "done");
  assert.throws(() => restored.rate({ perception: 3 }), /no rating/);
  assert.throws(() => restored.rate({ perception: 3, locomotion: 6, manipulation: 1, usability: 1 }), /no rating/);
  assert.equal(StudySession.restored(DEFAULT_STUDY, { participant: 1, step: 99, recorded: [] }), null);
});

test("the box plot shows quartiles, medians and means of each condition", () => {
  // NumPy: percentile([1, 2, 3, 4, 100], [25, 50, 75]) is 2, 3, 4.
  assert.deepEqual(boxOf([100, 3, 1, 2, 4]), { lower: 2, median: 3, upper: 4, mean: 22, whiskers: [1, 4], outliers: [100] });
  assert.deepEqual(boxOf([2]), { lower: 2, median: 2, upper: 2, mean: 2, whiskers: [2, 2], outliers: [] });
  assert.equal(boxOf([Number.NaN]), null);
  const recorded = Array.from({ length: 10 }, (_, ix) => participate(DEFAULT_STUDY, ix + 1)).flat();
  const ratings = ratingGroups(DEFAULT_STUDY, recorded);
  assert.deepEqual(ratings.map(({ label }) => label), ["perception", "locomotion", "manipulation", "usability"]);
  assert.ok(ratings.every(({ boxes }) => boxes.length === 5 && boxes.every((values) => values.length === 10)));
  assert.deepEqual(ratings[0]!.boxes[4], new Array(10).fill(5));
  const legend = [...DEFAULT_STUDY.conditions.map(({ label }) => label).slice(0, 4), "a < b & c"];
  const svg = boxPlot({ title: "ratings", axis: "rating", legend, groups: ratings, range: [1, 5] });
  assert.equal(svg.match(/class="box"/g)?.length, 20);
  assert.equal(svg.match(/data-median="5" data-mean="5"/g)?.length, 4);
  assert.ok(svg.includes("a &lt; b &amp; c") && svg.includes("n = 10") && !svg.includes("NaN"));
  const opened = svg.match(/<(g|svg|defs|pattern|text)[ >]/g)!.length;
  assert.equal(opened, svg.match(/<\/(g|svg|defs|pattern|text)>/g)!.length, "elements are closed");
});

test("tasks that ran out of time count in full, and those that were given up do not", () => {
  const task: Recorded = { participant: 1, kind: "task", place: 1, condition: "mesh-screen", item: "perceive", value: 120, outcome: "out of time" };
  const groups = durationGroups(DEFAULT_STUDY, [task, { ...task, participant: 2, value: 30, outcome: "given up" }]);
  const ix = DEFAULT_STUDY.conditions.findIndex(({ id }) => id === "mesh-screen");
  assert.deepEqual(groups[0]!.boxes[ix], [120]);
});

test("a study file replaces parts of the study, and others give one sentence", () => {
  const head = { format: "fieldrig-study", version: 1 };
  assert.deepEqual(studyIn(JSON.stringify(head)), DEFAULT_STUDY);
  const tasks = [{ id: "cup", title: "Cup", text: "Find the cup.", limit_s: 60 }];
  assert.deepEqual(studyIn(JSON.stringify({ ...head, scale: 7, tasks })), { ...DEFAULT_STUDY, scale: 7, tasks });
  const wrong: [file: unknown, problem: RegExp][] = [
    ["no JSON", /not JSON/],
    [[], /the file is not an object/],
    [{ format: "fieldrig-workspace", version: 1 }, /format and version/],
    [{ ...head, script: "alert(1)" }, /another key/],
    [{ ...head, tasks: [] }, /tasks is not a list of 1 to 12/],
    [{ ...head, tasks: [...tasks, ...tasks] }, /the same id/],
    [{ ...head, tasks: [{ ...tasks[0], limit_s: 0 }] }, /tasks\[0\]\.limit_s/],
    [{ ...head, tasks: [{ ...tasks[0], id: "<b>" }] }, /tasks\[0\]\.id/],
    [{ ...head, scale: 2.5 }, /scale is not a whole number from 3 to 11/],
    [{ ...head, conditions: [{ id: "a", label: "A", display: "wall", model: "splat", mode: "direct" }] }, /display/],
    [{ ...head, statements: [{ id: "a", text: "x".repeat(401) }] }, /statements\[0\]\.text/],
  ];
  for (const [file, problem] of wrong) {
    const read = studyIn(typeof file === "string" ? file : JSON.stringify(file));
    assert.ok(typeof read === "string" && problem.test(read) && !read.includes("\n"), `${JSON.stringify(file)}: ${String(read)}`);
  }
});

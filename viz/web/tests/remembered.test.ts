import assert from "node:assert/strict";
import { test } from "node:test";
import {
  decoded,
  encoded,
  fragmentWith,
  linkTo,
  MAX_PATH_VIEWS,
  NOTHING,
  onlyView,
  type Remembered,
  textInFragment,
} from "../src/view/remembered";
import type { ViewState } from "../src/view/view_state";

const VIEW: ViewState = {
  position: [1.25, -0.000001, 12.5],
  target: [0, 0.333333, -4],
  up: [0, 0, 1],
  fovDegrees: 50,
  mode: "orbit",
};
const PATH = [
  { position: [1, 2, 3], target: [0, 0, 0], fovDegrees: 40.5 },
  { position: [-1, 2, 3], target: [0, 0, 0.5], fovDegrees: 60 },
] satisfies Remembered["path"];
const ALL: Remembered = {
  view: { ...VIEW, up: [0, -1, 0], mode: "ride", attachedTo: "tool0", fovDegrees: 71.25 },
  switched: ["grid", "keyframes"],
  crop: { center: [-1, -2, 0.25], size: [2, 4, 6.5], yaw: 0.5 },
  method: "mean_color",
  path: PATH,
};

test("everything that is remembered returns from its text", () => {
  const some = [ALL, { ...NOTHING, view: VIEW }, { ...NOTHING, switched: ["age"] }, { ...NOTHING, path: PATH }];
  for (const remembered of some) assert.deepEqual(decoded(encoded(remembered)), remembered);
  assert.equal(decoded(encoded(NOTHING)), null);
});

test("the text needs no escapes in an address, and a usual one is short", () => {
  assert.match(encoded(ALL), /^[A-Za-z0-9._~-]+$/);
  assert.ok(encoded({ ...NOTHING, view: VIEW }).length < 60, encoded({ ...NOTHING, view: VIEW }));
  assert.equal(textInFragment(fragmentWith(encoded(ALL))), encoded(ALL));
});

test("only a ride can be tilted, so that other views have no direction of up", () => {
  const view: ViewState = { ...VIEW, up: [0.1, 0.2, 0.9], mode: "chase", attachedTo: "base" };
  assert.deepEqual(decoded(encoded({ ...NOTHING, view }))?.view, { ...view, up: [0, 0, 1] });
});

test("frames whose names need escapes are left out", () => {
  const view: ViewState = { ...VIEW, mode: "ride", attachedTo: "wrist camera" };
  assert.deepEqual(decoded(encoded({ ...NOTHING, view }))?.view, { ...VIEW, mode: "ride" });
});

test("whole numbers keep their zeros, and zero has no sign", () => {
  const view: ViewState = { ...VIEW, position: [100, -200, 0.1], target: [-0, 1e-9, -1e-9] };
  assert.equal(encoded({ ...NOTHING, view }), "1~p100_-200_0.1~t0_0_0~f50");
});

test("hostile and damaged texts give no view, and never fail", () => {
  const hostile = [
    "",
    "1",
    "2~p1_2_3~t0_0_0~f50",
    "~~~~~",
    "1~pNaN_0_0~t0_0_1",
    "1~pInfinity_0_0~t0_0_1",
    "1~p1e300_0_0~t0_0_1",
    "1~p0x10_0_0~t0_0_1",
    "1~p 1_0_0~t0_0_1",
    "1~p1_2~t0_0_0",
    "1~p1_2_3_4~t0_0_0",
    "1~p1_2_3",
    "1~p1_2_3~t1_2_3",
    "1~p999999_0_0~t0_0_0",
    "1~p1_2_3~t0_0_<img src=x onerror=alert(1)>",
    "1~l<script>_\"'",
    "1~sjavascript:alert(1)",
    "1~s../../etc",
    "1~c1_1_1_0_2_2",
    "1~c0_0_0_1_1_NaN",
    "1~k1_2_3",
    "1~k1_0_0_0_0_0_0_50",
    "1~k1_1_0_0_0_0_0_179",
    "1~k2_1_0_0_0_0_0_50",
    "1~k-1",
    "__proto__",
    "1~l__proto__",
    "%00",
    `1~p${"1".repeat(9000)}_0_0~t0_0_0`,
    `1~k${MAX_PATH_VIEWS + 1}_${Array.from({ length: MAX_PATH_VIEWS + 1 }, () => "1_0_0_0_0_0_50").join("_")}`,
    "1~".repeat(4000),
  ];
  for (const text of hostile) {
    const remembered = decoded(text);
    assert.ok(remembered === null || (remembered.view === null && remembered.crop === null), text);
    assert.deepEqual(remembered?.path ?? [], [], text);
  }
});

test("valid parts beside damaged ones are kept, with safe defaults", () => {
  const remembered = decoded("1~p1_2_3~t0_0_0~u0_0_0~m<b>~f999~a<i>~l?_grid_grid~c1~znew");
  assert.deepEqual(remembered, {
    ...NOTHING,
    view: { position: [1, 2, 3], target: [0, 0, 0], up: [0, 0, 1], mode: "orbit" },
    switched: ["grid"],
  });
});

test("a cut text is another view at most in its last part", () => {
  const text = encoded(ALL);
  for (let length = 0; length < text.length; length += 1) {
    const cut = decoded(text.slice(0, length));
    if (cut?.crop) assert.deepEqual(cut.view, ALL.view);
    assert.ok(!cut || cut.path.length === 0 || cut.path.length === PATH.length);
  }
});

test("links and kept fragments contain no token", () => {
  const text = encoded({ ...NOTHING, view: VIEW });
  const page = { origin: "https://robot:7007", pathname: "/", search: "?token=s3cret", hash: "#token=s3cret" };
  assert.equal(linkTo(page, text), `https://robot:7007/#view=${text}`);
  assert.equal(onlyView(`#token=s3cret&view=${text}`), `#view=${text}`);
  assert.equal(onlyView(`#view=${text}&token=s3cret`), `#view=${text}`);
  assert.equal(onlyView("#token=s3cret"), "");
  assert.equal(onlyView("#view=token-s3cret"), "");
  assert.equal(onlyView(`#view=${text}~ztoken-s3cret`), `#view=${text}`);
});

test("a path that is too long for a link is cut", () => {
  const path = Array.from({ length: MAX_PATH_VIEWS + 9 }, (_, ix) => ({ ...PATH[0]!, fovDegrees: 20 + ix / 2 }));
  assert.equal(decoded(encoded({ ...NOTHING, path }))!.path.length, MAX_PATH_VIEWS);
});

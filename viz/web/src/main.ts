// The operator's page: connects the connection, the view and the readouts.

import { keepToken, showRole } from "./connection/access";
import { Banner } from "./panels/banner";
import { Connection } from "./connection/connection";
import { EditControls } from "./panels/edit_controls";
import { element } from "./panels/element";
import { Header } from "./panels/header";
import { showGuidance } from "./panels/guidance";
import { setUpHelp, showKeysInTitles } from "./panels/help";
import { LinkReadout } from "./connection/link_readout";
import { LiveImages } from "./panels/live_images";
import { ModelSwitch } from "./panels/model_switch";
import { BACKGROUND, OrbitView } from "./view/orbit_view";
import { OverlayAges } from "./panels/overlay_ages";
import { panels } from "./panels/panels";
import { PictureInfo } from "./panels/picture_info";
import type { BinaryHeader, ModelStatus, PictureHeader, Status, TextMessage } from "./connection/protocol";
import { Readouts } from "./panels/readouts";
import { RenderScheduler } from "./connection/render_scheduler";
import { RobotAge } from "./panels/robot_age";
import { RunControls } from "./panels/run_controls";
import { ShownLatency } from "./connection/shown_latency";
import { SideView } from "./layers/side_view";
import { Surroundings } from "./layers/surroundings";
import { basePathTopic } from "./topics/base_path";
import { KeyframePointsTopic } from "./topics/keyframe_points";
import { KeyframesTopic } from "./topics/keyframes";
import { LiveImagesTopic } from "./topics/live_images";
import { ModelChunksTopic } from "./topics/model_chunks";
import { ObservationsTopic, TINTS } from "./topics/observations";
import { RangeScansTopic } from "./topics/range_scans";
import { robotTopic } from "./topics/robot_state";
import { statusTopic } from "./topics/status";
import { Topics } from "./topics/topic";
import { TrainingPanel } from "./panels/training_panel";
import { ViewSettings } from "./view/view_settings";

let stages = [0.1, 0.5, 1];
let latestStatus: Status | null = null;
let latestStep = -1;
let showsModel = true;

const readouts = new Readouts();
const operatorHeader = new Header();
const trainingPanel = new TrainingPanel();
const banner = new Banner();
const view = openView();
keepToken();
window.addEventListener("hashchange", () => {
  if (keepToken()) location.reload(); // The server assigns the role when the page connects.
});
// A page that becomes visible subscribes again, and receives all chunks again.
document.addEventListener("visibilitychange", () => {
  if (!document.hidden) view.local.clear();
});
const connection: Connection = new Connection(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`, {
  state(state, text) {
    const shown = element("connection");
    const before = shown.dataset.state;
    const wasOpen = before === "open" || before === "silent";
    const hasEnded = state === "lost" && banner.isFinished;
    shown.dataset.state = hasEnded ? "ended" : state;
    shown.textContent = hasEnded ? "the server has stopped" : text;
    // Operators who control the robot by the picture must see that it is frozen.
    banner.setConnection(state, text);
    view.overlays.setLive(state === "open");
    if (state === "open" && !wasOpen) {
      view.picture.forget();
      scheduler.restart();
      shownLatency.forget();
      forgetSurfaces();
      for (const side of sides) side.restart();
      topics.restart();
    }
    if (shown.dataset.state !== before) view.changed();
  },
  text: receiveText,
  binary: receiveBinary,
}, () => topics.capabilities);
const robotAge = new RobotAge(view.robot, connection.clock);
const overlayAges = new OverlayAges(view, () => connection.clock);
const pictureInfo = new PictureInfo(view, () => connection.clock, latestStepOf, () => stages);
const changed = (): void => topics.update();
const keyframes = new KeyframesTopic(view);
const images = new LiveImages(() => connection.clock, changed);
const liveImages = new LiveImagesTopic(view, images, changed);
const points = new KeyframePointsTopic(view, changed);
const scans = new RangeScansTopic(view, changed);
const observations = new ObservationsTopic(view, changed);
const chunks = new ModelChunksTopic(view, changed);
const topics = new Topics(connection, [
  statusTopic(receiveStatus),
  keyframes,
  liveImages,
  robotTopic(view, robotAge),
  points,
  scans,
  basePathTopic(view),
  observations,
  chunks,
]);
const runControls = new RunControls(connection);
new LinkReadout(connection);
const shownLatency = new ShownLatency(connection);
const models = new ModelSwitch(() => {
  shownLatency.forget();
  pictureInfo.modelChanged();
  scheduler.restart();
  forgetSurfaces();
  if (latestStatus) showStatus(latestStatus);
});
let isDrawnLocally = false;
const scheduler = new RenderScheduler(
  connection,
  () => view.view(),
  () => stages,
  BACKGROUND,
  () => models.method,
  pictureInfo,
);
const edits = new EditControls(connection, view.crop, () => models.method);
const sides = [new SideView(connection, "surroundings"), new SideView(connection, "video")] as const;
const surroundings = new Surroundings(
  sides[0],
  (shown) => scheduler.picture(shown),
  (map) => view.see("surroundings", map),
  () => view.forgetSurfaces(),
);
const settings = new ViewSettings(view, scheduler, sides[1]);

function openView(): OrbitView {
  if (!document.createElement("canvas").getContext("webgl2")) {
    const reason =
      "WebGL 2 is not available in this browser: turn on hardware acceleration in its settings, or use a newer browser";
    element("connection").textContent = "not connected";
    banner.setGraphics(reason);
    throw new Error(reason);
  }
  const canvas = element("canvas", HTMLCanvasElement);
  const view = new OrbitView(canvas, () => scheduler.moved(), () => connection.clock);
  // Mobile browsers discard the WebGL context of background pages. These listeners must run after the renderer's.
  canvas.addEventListener("webglcontextlost", () => {
    banner.setGraphics("The WebGL context of this page was lost: if the scene does not return, reload the page");
  });
  canvas.addEventListener("webglcontextrestored", () => {
    banner.setGraphics("");
    view.contextRestored();
  });
  return view;
}

function receiveStatus(status: Status): void {
  latestStatus = status;
  models.list(status);
  showStatus(status);
  runControls.show(status);
  operatorHeader.show(status);
  trainingPanel.show(status);
  banner.setRunResult(status.result);
  showGuidance(status.guidance, banner, liveImages);
  robotAge.hasEnded = banner.isFinished;
  overlayAges.hasEnded = banner.isFinished;
}

function receiveText(message: TextMessage): void {
  if (topics.receive(message)) return;
  switch (message.type) {
    case "hello":
      stages = message.default_stages;
      operatorHeader.client = message.client;
      showRole(message.role);
      showKeysInTitles(!isPressed("toggle-fly"));
      break;
    case "scene":
      view.setScene(message);
      break;
    case "error":
      if (edits.failed(message)) break;
      if (sides.some((side) => side.fail(message))) break;
      scheduler.failed(message.id);
      element("notice").textContent = message.message;
      break;
  }
}

function showStatus(status: Status): void {
  const model = models.shown(status);
  readouts.show(status, model);
  view.observations.nKeyframes = status.keyframes;
  const isEdited = edits.show(status, model);
  const isChanged = model.step !== latestStep;
  if (isChanged || isEdited) scheduler.modelChanged();
  if (isEdited) forgetSurfaces();
  else if (isChanged) surroundings.modelChanged();
  latestStep = model.step;
  updateLocalModel(model);
}

/** Number of steps of a model, as far as the status says. */
function latestStepOf(method: string | undefined): number | undefined {
  return [latestStatus, ...(latestStatus?.others ?? [])].find((model) => model?.method === method)?.step;
}

/** Forgets where surfaces are, because the model is another one or parts of it are gone. */
function forgetSurfaces(): void {
  surroundings.forget();
  view.forgetSurfaces();
}

/** Chooses whether the page or the server draws the model. */
function updateLocalModel(model: ModelStatus): void {
  const isPossible = topics.isSupported(chunks) && model.has_chunks === true;
  element("toggle-local").hidden = !isPossible;
  const method = isPossible && isDrawnLocally && showsModel ? model.method : null;
  chunks.method = method;
  scheduler.drawsLocally = method !== null;
}

function receiveBinary(header: BinaryHeader, payload: Uint8Array<ArrayBuffer>): void {
  if (header.type !== "picture") topics.receive(header, payload);
  else if (!sides.some((side) => side.receive(header, payload))) void showPicture(header, payload);
}

async function showPicture(header: PictureHeader, payload: Uint8Array<ArrayBuffer>): Promise<void> {
  const millis = scheduler.answered(header);
  const receivedAt = performance.now();
  try {
    if (!(await view.picture.show(header, payload, view.emptyDepth))) return;
  } catch (error) {
    scheduler.failed(header.id);
    element("notice").textContent = `Cannot show a picture: ${error instanceof Error ? error.message : String(error)}`;
    return;
  }
  if (header.color && showsModel) shownLatency.pictureReady(header, receivedAt);
  else shownLatency.restart();
  view.changed();
  view.seePicture();
  element("notice").textContent = "";
  if (header.color) pictureInfo.drawn(millis);
}

function isPressed(id: string): boolean {
  return element(id).getAttribute("aria-pressed") === "true";
}

function toggle(id: string, key: string, apply: (isOn: boolean) => void): void {
  const button = element(id, HTMLButtonElement);
  const flip = (): void => {
    const isOn = !isPressed(id);
    button.setAttribute("aria-pressed", String(isOn));
    apply(isOn);
    view.changed();
  };
  action(id, key, flip);
}

function action(id: string, key: string, act: () => void): void {
  element(id).addEventListener("click", act);
  window.addEventListener("keydown", (event) => {
    const isPlain = !event.ctrlKey && !event.metaKey && !event.altKey && !event.repeat;
    if (element(id).hidden || event.target instanceof HTMLInputElement || event.target instanceof HTMLSelectElement) {
      return;
    }
    if (isPlain && event.key.toLowerCase() === key) act();
  });
}

toggle("toggle-fly", "y", (isOn) => {
  view.flies = isOn;
  showKeysInTitles(!isOn);
});
action("reset-view", "r", () => view.reset());
action("full-screen", "u", () => {
  if (document.fullscreenElement) void document.exitFullscreen();
  else void document.documentElement.requestFullscreen();
});
setUpHelp();
action("look-top", "t", () => view.lookAlong("top"));
action("look-front", "f", () => view.lookAlong("front"));
action("look-nearest", "n", () => view.lookFromNearest(keyframes.list.keyframes));
action("look-live", "c", () => {
  const pose = liveImages.latest?.world_from_camera;
  if (pose) view.lookFrom(pose);
});
element("look-live", HTMLButtonElement).disabled = true;
toggle("toggle-model", "m", (isOn) => {
  showsModel = isOn;
  view.showsModel = isOn;
  if (latestStatus) showStatus(latestStatus);
});
toggle("toggle-local", "j", (isOn) => {
  isDrawnLocally = isOn;
  if (latestStatus) showStatus(latestStatus);
});
toggle("toggle-grid", "g", (isOn) => (view.overlays.showsGround = isOn));
toggle("toggle-keyframes", "k", (isOn) => (view.overlays.showsKeyframes = isOn));
toggle("toggle-crop", "x", (isOn) => (view.crop.enabled = isOn));
toggle("toggle-measure", "d", (isOn) => (view.measure.enabled = isOn));
toggle("toggle-images", "i", (isOn) => (liveImages.shown = isOn));
const switchPanel = panels({ "toggle-layers": "layers", "toggle-settings": "settings", "toggle-edit": "edit" });
const togglePanel = (button: string): void => {
  switchPanel(button);
  edits.opened();
};
action("toggle-layers", "e", () => togglePanel("toggle-layers"));
action("toggle-settings", "v", () => togglePanel("toggle-settings"));
action("toggle-edit", "q", () => {
  const button = element("toggle-edit", HTMLButtonElement);
  if (!button.hidden && !button.disabled) togglePanel("toggle-edit");
});
action("erase-box", "w", () => edits.eraseBox());
action("remove-floaters", "a", () => edits.removeFloaters());
action("undo-edit", "z", () => edits.undoLast());
toggle("toggle-follow", "l", (isOn) => (view.follows = isOn));
toggle("toggle-points", "p", (isOn) => (points.shown = isOn));
toggle("toggle-scans", "s", (isOn) => (scans.shown = isOn));
for (const { id, key, quantity } of TINTS) {
  toggle(id, key, (isOn) => {
    // At most one of them is on.
    for (const other of TINTS) if (other.id !== id) element(other.id).setAttribute("aria-pressed", "false");
    observations.tint = isOn ? quantity : null;
  });
}
toggle("toggle-robot", "b", (isOn) => (view.robot.enabled = isOn));
toggle("toggle-frames", "h", (isOn) => (view.frames.enabled = isOn));
toggle("toggle-occlude", "o", (isOn) => (view.occlusion.enabled = isOn));

function frame(): void {
  shownLatency.frameBegins();
  settings.tick();
  scheduler.tick();
  pictureInfo.update();
  if (!view.usesSurroundings || settings.isPlaying) {
    surroundings.forget();
    view.forgetSurroundings();
  } else if (view.needsSurroundings) {
    surroundings.tick(() => view.view(), models.method, view.isFlyingOrStopped);
  }
  view.draw();
  requestAnimationFrame(frame);
}
requestAnimationFrame(frame);

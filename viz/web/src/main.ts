// The operator's page: connects the connection, the view and the readouts.

import { keepToken, showRole } from "./connection/access";
import { announceStates } from "./panels/announcer";
import { Banner } from "./panels/banner";
import { BoxPanel } from "./panels/box_panel";
import { CoverageHint } from "./panels/coverage_hint";
import { Connection } from "./connection/connection";
import { EditControls } from "./panels/edit_controls";
import { element } from "./panels/element";
import { showGestureHint } from "./panels/gesture_hint";
import { Header } from "./panels/header";
import { showGuidance } from "./panels/guidance";
import { setUpHelp } from "./panels/help";
import { action, closesWithEscape, endsWithEscape, setFlying, setUpKeys, toggle } from "./keys";
import { KeyframeBrowser } from "./panels/keyframe_browser";
import { LinkReadout } from "./connection/link_readout";
import { LiveImages } from "./panels/live_images";
import { ModelSourceCard } from "./panels/model_source";
import { ModelSwitch } from "./panels/model_switch";
import { BACKGROUND, OrbitView } from "./view/orbit_view";
import { OverlayAges } from "./panels/overlay_ages";
import { NamedViews } from "./panels/named_views";
import { panels } from "./panels/panels";
import { PictureInfo } from "./panels/picture_info";
import type { BinaryHeader, ModelStatus, PictureHeader, Status, TextMessage } from "./connection/protocol";
import { Readouts } from "./panels/readouts";
import { RenderScheduler } from "./connection/render_scheduler";
import { RobotAge } from "./panels/robot_age";
import { RunControls } from "./panels/run_controls";
import { setUpSidePanel } from "./panels/side_panel";
import { RunEnd } from "./panels/run_end";
import { ShownLatency } from "./connection/shown_latency";
import { Skeleton } from "./panels/skeleton";
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
import { setUpToolbar } from "./panels/toolbar";
import { Tooltip } from "./panels/tooltip";
import { TrainingPanel } from "./panels/training_panel";
import { TimePhoto } from "./panels/time_photo";
import { TimeSlider } from "./panels/time_slider";
import { ViewMemory } from "./view/view_memory";
import { setUpSavePicture } from "./view/save_picture";
import { ViewControls } from "./view/view_controls";
import { ViewSettings } from "./view/view_settings";

let stages = [0.1, 0.5, 1];
let latestStatus: Status | null = null;
let latestStep = -1;
let showsModel = true;
let sceneRadiusM = 1;

const readouts = new Readouts();
const operatorHeader = new Header();
const trainingPanel = new TrainingPanel();
const banner = new Banner();
const view = openView();
const skeleton = new Skeleton(element("view"), element("canvas"));
keepToken();
window.addEventListener("hashchange", () => {
  if (keepToken()) location.reload(); // The server assigns the role when the page connects.
});
// A page that becomes visible subscribes again, and receives all chunks again.
document.addEventListener("visibilitychange", () => {
  if (!document.hidden && connection.isOpen) view.local.renew();
});
const connection: Connection = new Connection(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`, {
  state(state, text) {
    const shown = element("connection");
    const before = shown.dataset.state;
    const wasOpen = before === "open" || before === "silent";
    const hasEnded = state === "lost" && connection.hasStopped && banner.isFinished;
    shown.dataset.state = hasEnded ? "ended" : state;
    shown.textContent = hasEnded ? "the server has stopped" : text;
    // Operators who control the robot by the picture must see that it is frozen.
    banner.setConnection(state, text, hasEnded);
    runEnd.setEnded(hasEnded);
    modelSource.setEnded(hasEnded);
    skeleton.setConnection(state);
    view.overlays.setLive(state === "open");
    if (state === "open" && !wasOpen) {
      view.picture.forget();
      skeleton.awaitPicture();
      scheduler.restart();
      shownLatency.forget();
      forgetSurfaces();
      for (const side of sides) side.restart();
      browser.restart();
      coverage.restart();
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
const runEnd = new RunEnd();
const modelSource = new ModelSourceCard((up) => view.turnUp(up));
new LinkReadout(connection);
const shownLatency = new ShownLatency(connection);
const models = new ModelSwitch(() => {
  shownLatency.forget();
  pictureInfo.modelChanged();
  scheduler.restart();
  forgetSurfaces();
  browser.modelChanged(true);
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
new BoxPanel(view.crop);
const sides = [new SideView(connection, "surroundings"), new SideView(connection, "video")] as const;
const surroundings = new Surroundings(
  sides[0],
  (shown) => scheduler.picture(shown),
  (map) => view.see("surroundings", map),
  () => view.forgetSurfaces(),
);
const settings = new ViewSettings(view, scheduler, sides[1]);
setUpSavePicture(view);
const browser = new KeyframeBrowser({
  connection,
  view,
  topic: keyframes,
  common: () => scheduler.picture({ ...view.view(), crop: undefined }),
  live: () => liveImages.latest,
  radiusM: () => sceneRadiusM,
});
const coverage = new CoverageHint({ view, topic: observations, live: () => liveImages.latest });
const viewControls = new ViewControls(view, images);

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
    skeleton.isContextLost = true;
    banner.setGraphics("The WebGL context of this page was lost: if the scene does not return, reload the page");
  });
  canvas.addEventListener("webglcontextrestored", () => {
    banner.setGraphics("");
    view.contextRestored();
    skeleton.isContextLost = false;
    scheduler.restart();
  });
  return view;
}

function receiveStatus(status: Status): void {
  latestStatus = status;
  skeleton.setStatus(status);
  models.list(status);
  showStatus(status);
  runControls.show(status);
  operatorHeader.show(status);
  trainingPanel.show(status);
  banner.setStatus(status);
  runEnd.show(status);
  modelSource.show(status);
  showGuidance(status.guidance, banner, liveImages);
  robotAge.hasEnded = banner.isFinished;
  overlayAges.hasEnded = banner.isFinished;
  namedViews.runIs(status);
}

function receiveText(message: TextMessage): void {
  if (topics.receive(message)) return;
  switch (message.type) {
    case "hello":
      stages = message.default_stages;
      operatorHeader.client = message.client;
      showRole(message.role);
      edits.client = message.client;
      break;
    case "scene":
      view.setScene(message);
      coverage.setScene(message);
      sceneRadiusM = message.radius_m;
      break;
    case "error":
      if (edits.failed(message)) break;
      if (sides.some((side) => side.fail(message)) || browser.fail(message)) break;
      scheduler.failed(message.id);
      // The skeleton says what is missing.
      element("notice").textContent = skeleton.isVisible && !latestStatus?.keyframes ? "" : message.message;
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
  if (isChanged || isEdited) browser.modelChanged(isEdited);
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
  view.local.erased = model.erased_boxes ?? [];
}

function receiveBinary(header: BinaryHeader, payload: Uint8Array<ArrayBuffer>): void {
  if (browser.receive(header, payload)) return;
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
  skeleton.pictureShown(view.picture.posedDepth?.depth ?? null);
  if (header.color) view.local.pictureArrived();
  view.changed();
  view.seePicture();
  element("notice").textContent = "";
  if (header.color) pictureInfo.drawn(millis);
}

setUpKeys(() => view.changed());
announceStates();
setUpToolbar();
setUpSidePanel();
showGestureHint();
new Tooltip();
toggle("toggle-fly", "y", (isOn) => {
  view.flies = isOn;
  setFlying(isOn);
});
action("look-overview", "0 Home", () => view.showOverview());
action("reset-view", "r", () => view.reset());
action("full-screen", "u", () => {
  if (document.fullscreenElement) void document.exitFullscreen();
  else void document.documentElement.requestFullscreen();
});
setUpHelp();
action("look-top", "t", () => view.lookAlong("top"));
action("look-front", "f", () => view.lookAlong("front"));
action("look-nearest", "n", () => browser.toggle());
action("look-live", "c", () => viewControls.rideNext());
element("look-live", HTMLButtonElement).disabled = true;
toggle("toggle-model", "m", (isOn) => {
  showsModel = isOn;
  view.showsModel = isOn;
  skeleton.showsModel = isOn;
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
endsWithEscape("toggle-fly", "toggle-measure");
closesWithEscape("mode", () => images.isEnlarged, () => images.reduce());
toggle("toggle-images", "i", (isOn) => (liveImages.shown = isOn));
const switchPanel = panels({
  "toggle-layers": "layers",
  "toggle-settings": "settings",
  "toggle-edit": "edit",
  "toggle-views": "views",
  "toggle-history": "history",
});
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
for (const id of ["toggle-views", "toggle-history"]) element(id).addEventListener("click", () => togglePanel(id));
action("undo-edit", "z", () => edits.undoLast());
toggle("toggle-cut", "3", (isOn) => (view.isCut = isOn));
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
toggle("toggle-coverage", "4", (isOn) => (coverage.enabled = isOn));
toggle("toggle-robot", "b", (isOn) => (view.robot.enabled = isOn));
toggle("toggle-frames", "h", (isOn) => (view.frames.enabled = isOn));
toggle("toggle-occlude", "o", (isOn) => (view.occlusion.enabled = isOn));

// After all toggles have their listeners, because restoring a view presses them.
const memory = new ViewMemory(view, settings, models);
const namedViews = new NamedViews(memory);
new TimeSlider(keyframes, view, new TimePhoto(browser.photos));

function frame(): void {
  shownLatency.frameBegins();
  settings.tick();
  // Until the chunks in view have arrived, pictures of the server are shown.
  scheduler.drawsLocally = view.local.replacesPictures;
  chunks.showProgress();
  scheduler.tick();
  pictureInfo.update();
  if (!view.usesSurroundings || settings.isPlaying) {
    surroundings.forget();
    view.forgetSurroundings();
  } else if (view.needsSurroundings) {
    surroundings.tick(() => view.view(), models.method, view.isFlyingOrStopped);
  }
  view.draw();
  viewControls.update();
  requestAnimationFrame(frame);
}
requestAnimationFrame(frame);

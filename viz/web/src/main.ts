// The operator's page: connects the connection, the view and the readouts.

import { keepToken, showRole } from "./connection/access";
import { Connection } from "./connection/connection";
import { Flow } from "./connection/flow";
import { LinkReadout } from "./connection/link_readout";
import type { BinaryHeader, Status, TextMessage } from "./connection/protocol";
import { RenderScheduler } from "./connection/render_scheduler";
import { ShownLatency } from "./connection/shown_latency";
import { HeadsetLoader } from "./headset/headset_loader";
import { setUpKeys } from "./keys";
import { SideView } from "./layers/side_view";
import { Surroundings } from "./layers/surroundings";
import { announceStates } from "./panels/announcer";
import { Banner } from "./panels/banner";
import { BoxPanel } from "./panels/box_panel";
import { setUpButtons } from "./panels/buttons";
import { ConnectionState } from "./panels/connection_state";
import { CoverageHint } from "./panels/coverage_hint";
import { EditControls } from "./panels/edit_controls";
import { element } from "./panels/element";
import { setUpFolding } from "./panels/folding";
import { showGestureHint } from "./panels/gesture_hint";
import { showGuidance } from "./panels/guidance";
import { markClickedButtons } from "./panels/focus";
import { Header } from "./panels/header";
import { setUpHelp } from "./panels/help";
import { KeyframeBrowser } from "./panels/keyframe_browser";
import { LiveImages } from "./panels/live_images";
import { ModelSourceCard } from "./panels/model_source";
import { ModelSwitch } from "./panels/model_switch";
import { NamedViews } from "./panels/named_views";
import { NewRun } from "./panels/new_run";
import { OverlayAges } from "./panels/overlay_ages";
import { setUpPanels } from "./panels/panels";
import { Preview } from "./panels/preview";
import { CoverageOverlay } from "./panels/photograph_coverage";
import { PictureInfo } from "./panels/picture_info";
import { Readouts } from "./panels/readouts";
import { RobotAge } from "./panels/robot_age";
import { CONTROLLABLE, RunControls } from "./panels/run_controls";
import { RunEnd } from "./panels/run_end";
import { ShownModel } from "./panels/shown_model";
import { reasonOf } from "./panels/sentence";
import { setUpSidePanel } from "./panels/side_panel";
import { Skeleton } from "./panels/skeleton";
import { TimePhoto } from "./panels/time_photo";
import { TimeSlider } from "./panels/time_slider";
import { showToast } from "./panels/toast";
import { setUpToolbar } from "./panels/toolbar";
import { Tooltip } from "./panels/tooltip";
import { TrainingPanel } from "./panels/training_panel";
import { SteeringLoader } from "./steering/steering_loader";
import { basePathTopic } from "./topics/base_path";
import { KeyframePointsTopic } from "./topics/keyframe_points";
import { KeyframesTopic } from "./topics/keyframes";
import { LiveImagesTopic } from "./topics/live_images";
import { ModelChunksTopic } from "./topics/model_chunks";
import { ObservationsTopic } from "./topics/observations";
import { RangeScansTopic } from "./topics/range_scans";
import { robotTopic } from "./topics/robot_state";
import { statusTopic } from "./topics/status";
import { Topics } from "./topics/topic";
import { MainPicture } from "./view/main_picture";
import { openView } from "./view/open_view";
import { BACKGROUND } from "./view/orbit_view";
import { setUpSavePicture } from "./view/save_picture";
import { ViewControls } from "./view/view_controls";
import { ViewMemory } from "./view/view_memory";
import { ViewSettings } from "./view/view_settings";
import { WorkspaceFiles } from "./workspace/workspace_files";

let stages = [0.1, 0.5, 1];
let sceneRadiusM = 1;

keepToken();
window.addEventListener("hashchange", () => {
  if (keepToken()) location.reload(); // The server assigns the role when the page connects.
});

// The view and the connection.
const banner = new Banner();
const view = openView(banner, {
  clock: () => connection.clock,
  moved: () => scheduler.moved(),
  contextChanged(isLost) {
    skeleton.isContextLost = isLost;
    if (!isLost) scheduler.restart();
  },
});
const skeleton = new Skeleton(element("view"), element("canvas"));
const flow = new Flow();
const connectionState = new ConnectionState({
  hasEnded: () => connection.hasStopped && banner.isFinished,
  show({ state, text, hasEnded }) {
    // Operators who control the robot by the picture must see that it is frozen.
    banner.setConnection(state, text, hasEnded);
    runEnd.setEnded(hasEnded);
    modelSource.setEnded(hasEnded);
    skeleton.setConnection(state);
    view.overlays.setLive(state === "open");
    pictureInfo.isConnected = connection.isOpen;
    if (!connection.isOpen) header.disconnected();
  },
  restart,
  changed: () => view.changed(),
  // The skeleton says what is missing before the first picture.
  problem: () => flow.problem(skeleton.isVisible || preview.isOn ? null : pictureInfo.waitingMillis),
});
const connection: Connection = new Connection(
  `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`,
  { state: (state, text) => connectionState.receive(state, text), text: receiveText, binary: receiveBinary },
  () => topics.capabilities,
);

// What is shown of the run.
const readouts = new Readouts();
const header = new Header();
const trainingPanel = new TrainingPanel();
const runControls = new RunControls(connection);
const runEnd = new RunEnd();
const modelSource = new ModelSourceCard((up) => view.turnUp(up));
const robotAge = new RobotAge(view.robot, connection.clock);
const overlayAges = new OverlayAges(view, () => connection.clock);
const shownLatency = new ShownLatency(connection);
new LinkReadout(connection);

// The data besides pictures.
const changed = (): void => topics.update();
const images = new LiveImages(() => connection.clock, changed);
const keyframes = new KeyframesTopic(view);
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

// The model and its pictures.
const models = new ModelSwitch(() => {
  shownLatency.forget();
  pictureInfo.modelChanged();
  scheduler.restart();
  model.forgetSurfaces();
  browser.modelChanged(true);
  model.update();
});
const pictureInfo = new PictureInfo(view, () => connection.clock, (method) => model.stepOf(method), () => stages);
const scheduler = new RenderScheduler(
  connection,
  () => view.view(),
  () => stages,
  BACKGROUND,
  () => models.method,
  pictureInfo,
);
const sides = [new SideView(connection, "surroundings"), new SideView(connection, "video")] as const;
const headsetSides = {
  left: new SideView(connection, "left eye"),
  right: new SideView(connection, "right eye"),
  extra: new SideView(connection, "hand or sphere"),
};
const allSides = [...sides, ...Object.values(headsetSides)];
const surroundings = new Surroundings(
  sides[0],
  (shown) => scheduler.picture(shown),
  (map) => view.see("surroundings", map),
  () => view.forgetSurfaces(),
);
const edits = new EditControls(connection, view.crop, () => models.method);
const browser = new KeyframeBrowser({
  connection,
  view,
  topic: keyframes,
  common: () => scheduler.picture({ ...view.view(), crop: undefined }),
  liveImages,
  radiusM: () => sceneRadiusM,
});
const model = new ShownModel({ view, models, readouts, edits, scheduler, browser, surroundings, topics, chunks });
const photographCoverage = new CoverageOverlay();
const preview = new Preview(model, skeleton, liveImages);
const picture = new MainPicture({
  view,
  scheduler,
  skeleton,
  info: pictureInfo,
  latency: shownLatency,
  isModelVisible: () => model.isVisible,
});

// What the user controls.
const coverage = new CoverageHint({
  view,
  topic: observations,
  live: () => liveImages.current,
  keyframes: () => keyframes.list.keyframes,
});
const viewControls = new ViewControls(view, images);
const timeSlider = new TimeSlider(keyframes, view, new TimePhoto(browser.photos));
const settings = new ViewSettings(view, scheduler, sides[1]);
new BoxPanel(view.crop);
const steering = new SteeringLoader(view);
const headset = new HeadsetLoader({
  view,
  prepareFrame,
  moved: () => scheduler.moved(),
  posedImages: () => liveImages.current,
  steering: () => steering.loaded?.hands ?? null,
  pictures: {
    sides: headsetSides,
    request: (shown) => scheduler.picture(shown),
    isTraining: () => model.status?.state === "training",
  },
});
topics.isPresented = () => headset.isInUse;
setUpSavePicture(view, pictureInfo, () => model.status?.identity);
setUpKeys(() => view.changed());
setUpButtons({
  view,
  viewControls,
  browser,
  coverage,
  images,
  model,
  skeleton,
  keyframes,
  liveImages,
  points,
  scans,
  observations,
});
setUpPanels([
  { button: "toggle-layers", panel: "layers" },
  { button: "toggle-settings", panel: "settings" },
  { button: "toggle-edit", panel: "edit", onToggle: (isOpen) => (edits.isOpen = isOpen) },
  { button: "toggle-steer", panel: "steer" },
  { button: "toggle-incidents", panel: "incidents" },
  { button: "toggle-views", panel: "views" },
  { button: "toggle-history", panel: "history", onToggle: (isOpen) => timeSlider.opened(isOpen) },
]);
setUpHelp();
setUpToolbar();
setUpSidePanel();
setUpFolding();
markClickedButtons();
announceStates();
showGestureHint();
new Tooltip();
// After all toggles have their listeners, because restoring a view presses them.
const memory = new ViewMemory(view, settings, models);
const namedViews = new NamedViews(memory);
const workspaces = new WorkspaceFiles({ memory, view, images, identity: () => model.status?.identity, say: showToast });

if (new URLSearchParams(location.search).has("study")) void openStudy();

/** Called when a new connection is open. The server may be another one, and does not know earlier requests. */
function restart(): void {
  view.picture.forget();
  skeleton.awaitPicture();
  shownLatency.forget();
  model.forgetSurfaces();
  for (const part of [flow, scheduler, ...allSides, edits, browser, coverage, topics]) part.restart();
}

/** Forgets what only belongs to the run that was shown before. */
const newRun = new NewRun((sentence) => {
  view.picture.remove();
  view.local.forgetRun();
  view.measure.clear();
  skeleton.forgetPicture();
  images.clear();
  view.robot.forgetRun();
  scheduler.restart();
  view.changed();
  showToast(sentence);
});

async function openStudy(): Promise<void> {
  try {
    const { StudyPage } = await import("./study/study_page");
    const methods = (): string[] => (model.status ? [model.status, ...model.status.others].map(({ method }) => method) : []);
    new StudyPage(document.querySelector(".tools")!, { memory, resetView: () => view.reset(), methods, say: showToast });
  } catch (error) {
    showToast(`The study cannot be loaded: ${reasonOf(error)}`);
  }
}

function receiveStatus(status: Status): void {
  newRun.show(status);
  skeleton.setStatus(status);
  model.receive(status);
  for (const part of [runControls, header, trainingPanel, runEnd, modelSource]) part.show(status);
  banner.setStatus(status);
  showGuidance(status.guidance, banner, liveImages);
  photographCoverage.show(status.guidance?.coverage);
  preview.show(status);
  const hasInputEnded = status.input_ended ?? false;
  for (const ages of [robotAge, overlayAges]) ages.hasEnded = banner.isFinished || hasInputEnded;
  coverage.hasInputEnded = hasInputEnded;
  namedViews.runIs(status);
  steering.offered = status.steering === true;
  steering.showIncidents(status.files ?? []);
  flow.isReading = CONTROLLABLE.includes(status.state) && !hasInputEnded;
}

function receiveText(message: TextMessage): void {
  flow.received(message.type);
  if (topics.receive(message)) return;
  switch (message.type) {
    case "hello":
      stages = message.default_stages;
      header.client = message.client;
      edits.client = message.client;
      showRole(message.role);
      workspaces.serverHasOne(message.has_workspace ?? false);
      break;
    case "scene":
      sceneRadiusM = message.radius_m;
      view.setScene(message);
      coverage.setScene(message);
      break;
    case "error":
      if ([edits, ...allSides, browser].some((part) => part.fail(message))) break;
      // The skeleton already shows what is missing.
      picture.failed(message.id, preview.isOn || (skeleton.isVisible && !model.status?.keyframes) ? "" : message.message);
      break;
  }
}

function receiveBinary(header: BinaryHeader, payload: Uint8Array<ArrayBuffer>): void {
  flow.received(header.type);
  if (browser.receive(header, payload)) return;
  if (header.type !== "picture") topics.receive(header, payload);
  else if (!allSides.some((side) => side.receive(header, payload))) void picture.receive(header, payload);
}

/** What the page does for each display refresh, of its own window or of a headset, before the view is drawn. */
function prepareFrame(): void {
  shownLatency.frameBegins();
  settings.tick();
  // Until the chunks in view have arrived, pictures of the server are shown.
  scheduler.drawsLocally = view.replacesPictures;
  if (!preview.isOn) scheduler.tick();
  pictureInfo.update();
  if (!view.usesSurroundings || settings.isPlaying) {
    surroundings.forget();
    view.forgetSurroundings();
  } else if (view.needsSurroundings) {
    surroundings.tick(() => view.view(), models.method, view.isFlyingOrStopped);
  }
}

function frame(): void {
  // Some browsers stop these frames while a headset is in use, and others do not.
  if (!headset.isInUse) {
    prepareFrame();
    view.draw();
    viewControls.update();
  }
  requestAnimationFrame(frame);
}
requestAnimationFrame(frame);

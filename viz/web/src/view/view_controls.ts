// Buttons and notices of the view. They show what the view is attached to, what is cut away, why
// the eye stops, and where the robot is.

import { blockText, canBeCut } from "./block";
import { inDeviceWords } from "../panels/devices";
import { element } from "../panels/element";
import { FrameChooser, frameName } from "./frame_chooser";
import { setText } from "../panels/html";
import type { LiveImages } from "../panels/live_images";
import type { OrbitView } from "./orbit_view";
import { RobotArrow } from "./robot_arrow";
import { isPressed, setFlying } from "../keys";
import { nextCamera } from "./ride";

/** Time for which the reason is shown after the eye was stopped. */
const BLOCKED_MILLIS = 6000;
/** Unknown space usually becomes known within this time. The reason is shown only if the eye is stopped for longer. */
const WAIT_MILLIS = 1500;

export class ViewControls {
  private readonly arrow: RobotArrow;
  private readonly frames: FrameChooser;
  private readonly blocked = element("blocked");
  private shownMode = "";
  /** Time since which the eye has been stopped repeatedly. */
  private stoppedSince = -Infinity;
  private lastStop = -Infinity;

  constructor(
    private readonly view: OrbitView,
    private readonly images: LiveImages,
  ) {
    this.arrow = new RobotArrow(() => view.showOverview());
    this.frames = new FrameChooser((frame) => (view.attachment.frame = frame));
    images.ride = (camera) => {
      if (view.attachment.riddenCamera === camera) view.attachment.end();
      else view.ride(camera);
    };
    element("cut-away").addEventListener("click", () => this.setCut(true));
    element("end-cut").addEventListener("click", () => this.setCut(false));
  }

  /** Attaches the view to the camera after the present one. */
  rideNext(): void {
    const { cameraNames, riddenCamera } = this.view.attachment;
    const camera = nextCamera(cameraNames, riddenCamera);
    if (camera !== null) this.view.ride(camera);
  }

  /** Called for every display refresh. */
  update(): void {
    this.showMode();
    this.showBlock();
    this.arrow.show(this.view.arrow);
  }

  private setCut(isCut: boolean): void {
    if (this.view.isCut !== isCut) element("toggle-cut").click();
  }

  /** Shows the mode at its buttons. The mode also changes when the user moves the view, and when a view is restored. */
  private showMode(): void {
    const { view } = this;
    const { riddenCamera, frame } = view.attachment;
    const mode = [view.mode, riddenCamera, frame, view.robot.linkNames.length, view.isCut].join();
    if (mode === this.shownMode) return;
    this.shownMode = mode;
    this.showFlying(view.mode === "fly");
    press("toggle-follow", view.mode === "chase");
    setText(element("follow-text"), view.mode === "chase" ? `following ${frameName(frame)}` : "");
    press("look-live", view.mode === "ride");
    press("toggle-cut", view.isCut);
    this.frames.show(view.robot, frame);
    for (const id of ["toggle-robot", "toggle-follow"]) element(id).hidden = !view.robot.namedLinks;
    this.images.ridden = riddenCamera;
    element("cut-chip").hidden = !view.isCut;
  }

  private showFlying(isFlying: boolean): void {
    if (isFlying === isPressed("toggle-fly")) return;
    press("toggle-fly", isFlying);
    setFlying(isFlying);
  }

  /** Shows why the eye was stopped, and offers to cut the wall away. */
  private showBlock(): void {
    const { block } = this.view;
    const now = performance.now();
    if (block && block.at > this.lastStop) {
      if (block.at - this.lastStop > WAIT_MILLIS) this.stoppedSince = block.at;
      this.lastStop = block.at;
    }
    const isUnknown = block?.what.by === "unknown space";
    const hasWaited = block !== null && (!isUnknown || this.lastStop - this.stoppedSince > WAIT_MILLIS);
    const isShown = hasWaited && now - this.lastStop < BLOCKED_MILLIS && !this.view.isCut;
    if (isShown) {
      setText(element("blocked-text"), inDeviceWords(blockText(block.what)));
      element("cut-away").hidden = !canBeCut(block.what);
    }
    if (this.blocked.hidden === isShown) this.blocked.hidden = !isShown;
  }
}

function press(id: string, isOn: boolean): void {
  element(id).setAttribute("aria-pressed", String(isOn));
}

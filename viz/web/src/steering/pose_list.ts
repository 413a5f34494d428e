// The stored poses: a name for the present pose, and the way to one of them by a preview.

import { element } from "../panels/element";
import { make } from "../panels/html";
import { store, stored } from "../panels/storage";
import type { Commander } from "./commander";
import { freePoseName, MAX_POSES, positionsFor, type StoredPose, storedPosesIn, withPose } from "./stored_poses";

const KEY = "steer-poses";

export class PoseList {
  private poses: StoredPose[] = [];
  private readonly input = element("steer-name", HTMLInputElement);

  constructor(
    private readonly commander: Commander,
    private readonly notice: (text: string) => void,
  ) {
    element("steer-save").addEventListener("submit", (event) => {
      event.preventDefault();
      this.save();
    });
    // Another tab may have stored a pose.
    element("steer-stored").addEventListener("toggle", () => this.read());
    this.read();
  }

  private save(): void {
    const { arm, state } = this.commander;
    if (!arm || !state) return;
    const joints = Object.fromEntries(arm.joints.map(({ name }, ix) => [name, state.position[ix] ?? 0]));
    const poses = withPose(this.poses, { name: this.input.value, joints });
    if (!poses) this.notice(`There are already ${MAX_POSES} poses: delete one first`);
    else this.change(poses);
    if (poses) this.input.value = "";
  }

  private read(): void {
    this.poses = storedPosesIn(stored(KEY));
    this.list();
  }

  private change(poses: StoredPose[]): void {
    this.poses = poses;
    if (!store(KEY, JSON.stringify(poses))) this.notice("The browser stores nothing: the poses are lost when the page is closed");
    this.list();
  }

  private list(): void {
    this.input.placeholder = freePoseName(this.poses);
    element("steer-poses").replaceChildren(...this.poses.map((pose) => this.row(pose)));
  }

  private row(pose: StoredPose): HTMLLIElement {
    const row = make("li");
    const show = make("button", { textContent: pose.name, className: "name", title: "Show the ghost in this pose. Go moves the arm" });
    show.addEventListener("click", () => this.preview(pose));
    const remove = make("button", { textContent: "✕", title: `Delete “${pose.name}”`, ariaLabel: `Delete “${pose.name}”` });
    remove.addEventListener("click", () => this.change(this.poses.filter((other) => other !== pose)));
    row.append(show, remove);
    return row;
  }

  private preview(pose: StoredPose): void {
    const names = this.commander.arm?.joints.map(({ name }) => name) ?? [];
    const positions = positionsFor(pose, names);
    if (positions) this.commander.preview(positions);
    else this.notice(`“${pose.name}” belongs to an arm with other joints`);
  }
}

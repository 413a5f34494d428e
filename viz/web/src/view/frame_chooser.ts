// The list in the view panel with the frames of the robot that the view can follow.

import { element } from "../panels/element";
import type { RobotLayer } from "../layers/robot_layer";

/** Names of frames that every robot has; others are names of links. */
export const BASE_FRAME = "@base";
export const TOOL_FRAME = "@tool";

/** The link of a frame; null before the robot is known. */
export function linkOf(frame: string, robot: RobotLayer): string | null {
  const named = robot.namedLinks;
  if (!named) return null;
  if (frame === BASE_FRAME) return named.base;
  return frame === TOOL_FRAME ? named.tool : frame;
}

/** The name of a frame for the user. */
export function frameName(frame: string): string {
  return frame === BASE_FRAME ? "base" : frame === TOOL_FRAME ? "tool" : frame;
}

export class FrameChooser {
  private readonly list = element("follow-frame", HTMLSelectElement);
  private listed = "";

  constructor(choose: (frame: string) => void) {
    this.list.addEventListener("change", () => choose(this.list.value));
  }

  /** Lists the frames of the robot, and selects one. */
  show(robot: RobotLayer, frame: string): void {
    const named = robot.namedLinks;
    for (const part of document.querySelectorAll<HTMLElement>(".follow-frame")) part.hidden = !named;
    if (!named) return;
    const key = JSON.stringify([named, robot.linkNames]);
    if (key !== this.listed) {
      this.listed = key;
      const links = robot.linkNames.map((name) => new Option(name, name));
      const first = [new Option(`base (${named.base})`, BASE_FRAME), new Option(`tool (${named.tool})`, TOOL_FRAME)];
      this.list.replaceChildren(...first, ...links);
    }
    if (document.activeElement !== this.list) this.list.value = frame;
  }
}

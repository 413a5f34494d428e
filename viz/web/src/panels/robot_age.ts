// Shows how old the drawn pose of the robot is, as soon as it is not live.

import { element } from "./element";
import { ageText } from "./quantities";
import type { RobotState } from "../connection/protocol";
import type { RobotLayer } from "../layers/robot_layer";
import type { ServerClock } from "../connection/server_clock";

/** Poses older than this are not live. */
const LIVE_MILLIS = 500;

export class RobotAge {
  /** Whether the run has ended, so that an outdated pose is expected. */
  hasEnded = false;
  private capturedMillis: number | null = null;

  constructor(private readonly robot: RobotLayer, private readonly clock: ServerClock) {
    window.setInterval(() => this.show(), 100);
  }

  received(state: RobotState): void {
    this.capturedMillis = state.captured_millis;
  }

  /** Forgets the age, because a new server has a new clock. */
  forget(): void {
    if (this.capturedMillis !== null) this.capturedMillis = -Infinity;
  }

  private show(): void {
    const label = element("robot-age");
    if (this.capturedMillis === null) return;
    const age = this.clock.age(this.capturedMillis) ?? Infinity;
    const isLive = age <= LIVE_MILLIS;
    this.robot.setOutdated(!isLive);
    label.hidden = isLive || this.hasEnded;
    if (!isLive) label.textContent = `robot ${ageText(age)}`;
  }
}

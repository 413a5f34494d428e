// Adapts the overview when the scene, the robot or its path have grown out of the picture.

import { Box3 } from "three";
import type { Viewpoint } from "./eye_guard";
import { cornersOf, type Lens, outgrows, overviewDirection, viewOf } from "./overview";

/** Where an overview looks to: the heading of a robot or, without one, of a camera. */
export interface Heading {
  rad: number;
  isRobot: boolean;
}

export class OverviewKeeper {
  /** What is in the picture. */
  private readonly shown = new Box3();
  private heading: Heading | null = null;

  /** Looks in the direction of the present heading at the next update. */
  restart(): void {
    this.heading = null;
    this.refit();
  }

  /** Fits everything into the picture again at the next update, because its shape has changed. */
  refit(): void {
    this.shown.makeEmpty();
  }

  /** The overview of these boxes if the present one does not show all of them; otherwise null. */
  update(boxes: Box3[], heading: Heading, lens: Lens): Viewpoint | null {
    const content = boxes.reduce((all, box) => all.union(box), new Box3());
    const isFirstRobot = heading.isRobot && !this.heading?.isRobot;
    if (content.isEmpty() || !(isFirstRobot || outgrows(content, this.shown))) return null;
    // A robot that turns does not turn the view.
    if (isFirstRobot) this.heading = heading;
    this.heading ??= heading;
    // The overview only grows, so that an arm that moves back and forth does not move it each time.
    this.shown.union(content);
    return viewOf(cornersOf([...boxes, this.shown]), overviewDirection(this.heading.rad, this.heading.isRobot), lens);
  }
}

// The limits that act on the arm now: as a list below the view, as labels at their places, and for screen readers.

import * as THREE from "three";
import { announce } from "../panels/announcer";
import { element } from "../panels/element";
import { child } from "../panels/html";
import type { Commander } from "./commander";
import type { Mark, Marks } from "./marks";
import type { Limit, Part, Point } from "./messages";
import type { Pose } from "./pose";
import { limitText, shownLimits, verdictText } from "./texts";
import { mayGo } from "./goal";

/** Texts contain distances that change all the time. The list is not changed more often than this. */
const MIN_CHANGE_MILLIS = 250;
/** A limit is announced again only after this time. */
const REPEAT_MILLIS = 5000;

export class LimitsList {
  private readonly list = element("steer-limits");
  private shown = "";
  private changedMillis = -Infinity;
  private announced = new Map<string, number>();

  constructor(
    private readonly commander: Commander,
    private readonly marks: Marks,
  ) {}

  /** `frames`: those of the places of both parts in the world; null without a link. */
  show(frames: Record<Part, Pose | null> | null): void {
    const { state, deadMan } = this.commander;
    const limits = shownLimits(state?.limits ?? [], deadMan.grip !== null);
    this.showList(limits.map((limit) => ({ key: `${limit.link} ${limit.effect}`, effect: limit.effect, text: limitText(limit) })));
    this.marks.show(frames ? this.marksOf(limits, frames) : []);
  }

  private marksOf(limits: readonly Limit[], frames: Record<Part, Pose | null>): Mark[] {
    const { judgment, target } = this.commander.goal;
    const ofGoal: { part: Part; place: Point | null; effect: string; text: string }[] = [];
    if (target && judgment && judgment.verdict !== "reachable") {
      const { verdict, text, place } = judgment;
      ofGoal.push({ part: "arm", place, effect: mayGo(verdict) ? "slowed" : "refused", text: verdictText(verdict, text) });
    }
    const applied = limits.map((limit) => ({ ...limit, text: limitText(limit) }));
    return [...applied, ...ofGoal].flatMap(({ part, place, effect, text }) => {
      const frame = frames[part];
      if (!place || !frame) return [];
      return [{ worldPoint: new THREE.Vector3(...place).applyQuaternion(frame.rotation).add(frame.position), effect, text }];
    });
  }

  private showList(entries: { key: string; effect: string; text: string }[]): void {
    const now = performance.now();
    const shown = entries.map(({ text }) => text).join("\n");
    const isOther = (shown === "") !== (this.shown === "");
    if (shown === this.shown || (!isOther && now - this.changedMillis < MIN_CHANGE_MILLIS)) return;
    this.shown = shown;
    this.changedMillis = now;
    this.list.hidden = entries.length === 0;
    this.list.replaceChildren(
      ...entries.map(({ effect, text }) => {
        const row = child("li", text);
        row.dataset.effect = effect;
        return row;
      }),
    );
    for (const { key, text } of entries) {
      if (now - (this.announced.get(key) ?? -Infinity) > REPEAT_MILLIS) {
        announce(text);
        this.announced.set(key, now);
      }
    }
  }
}

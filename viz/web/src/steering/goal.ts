// The goal of "preview then go": where it is, what the server says about it, and when to ask. This file has no DOM.

import type { Intent, Point, PreviewAnswer, PreviewTarget, SteerRequest, Verdict } from "./messages";
import { numbersOf, type Pose } from "./pose";

/** Minimum time between two questions, and time after which an answer is not expected any more. */
const PERIOD_MILLIS = 100;
const LOST_MILLIS = 2000;
/** The arm is at the goal if no joint is farther away, radians or meters. */
const REACHED = 0.004;

/** A pose of the tip in the base, or positions of the joints. */
export type GoalTarget = { kind: "pose"; baseFromTip: Pose } | { kind: "joints"; position: number[] };

/** What is known about a goal. */
export interface Judgment {
  verdict: Verdict;
  text: string;
  position: number[] | null;
  place: Point | null;
}

export class Goal {
  private wanted: GoalTarget | null = null;
  private judged: Judgment | null = null;
  private nextId = 1;
  private asked: { id: number; isNewest: boolean; atMillis: number } | null = null;
  private askedMillis = -Infinity;

  /** The goal; null without one. */
  get target(): GoalTarget | null {
    return this.wanted;
  }

  /** The answer for the goal or, while it is dragged, for where it was shortly before; null before the first answer. */
  get judgment(): Judgment | null {
    return this.judged;
  }

  /** Whether the answer belongs to the present goal. */
  get isJudged(): boolean {
    return this.judged !== null && this.asked === null;
  }

  set(target: GoalTarget): void {
    this.wanted = target;
    if (this.asked) this.asked.isNewest = false;
    else this.asked = { id: 0, isNewest: false, atMillis: -Infinity };
  }

  clear(): void {
    this.wanted = null;
    this.judged = null;
    this.asked = null;
  }

  /** The next question to the server, if it is time for one. */
  question(nowMillis: number): SteerRequest | null {
    const { wanted, asked } = this;
    if (!wanted || !asked || nowMillis - this.askedMillis < PERIOD_MILLIS) return null;
    const isPending = asked.id !== 0 && nowMillis - asked.atMillis < LOST_MILLIS;
    if (isPending) return null;
    const id = this.nextId++;
    this.asked = { id, isNewest: true, atMillis: nowMillis };
    this.askedMillis = nowMillis;
    return { type: "preview", id, ...targetMessage(wanted) };
  }

  /** Adopts an answer. Returns false if it belongs to an earlier goal that was given up. */
  answer({ id, verdict, text, position, place }: PreviewAnswer): boolean {
    if (!this.wanted || this.asked?.id !== id) return false;
    this.judged = { verdict, text, position, place };
    // The goal has moved on: the answer is shown, and another question follows.
    this.asked = this.asked.isNewest ? null : { id: 0, isNewest: false, atMillis: -Infinity };
    return true;
  }

  /** The intent that moves the arm to the goal; null while it is not known to be permitted. */
  get intent(): Intent | null {
    const { wanted, judged } = this;
    if (!wanted || !judged || !this.isJudged || !mayGo(judged.verdict)) return null;
    if (judged.position) return { kind: "joints", position: judged.position };
    if (wanted.kind === "joints") return { kind: "joints", position: wanted.position };
    return { kind: "pose", base_from_tip: numbersOf(wanted.baseFromTip) };
  }

  /** Whether the joints are at the goal. Those of an answer without permission are only close to it. */
  isReached(position: readonly number[]): boolean {
    const goal = this.judged?.position;
    if (!goal || !this.isJudged || !mayGo(this.judged!.verdict) || goal.length !== position.length) return false;
    return goal.every((value, ix) => Math.abs(value - position[ix]!) < REACHED);
  }
}

/** Whether the arm can move to a goal. Close to surfaces, the chain slows it down. */
export function mayGo(verdict: Verdict): boolean {
  return verdict === "reachable" || verdict === "near";
}

function targetMessage(target: GoalTarget): PreviewTarget {
  if (target.kind === "joints") return { position: target.position };
  return { base_from_tip: numbersOf(target.baseFromTip) };
}

// Keeps the frame rate of a headset. Most of the cost of splats is in the pixels that they cover, and not in their number, so
// the governor works on covered pixels: their estimate from the projections of the splats, and the measured frame times. It
// lowers the extent of splats, then the size of the viewport, the foveation, and only then the number of splats. If even that
// does not suffice, the server draws. This file has no DOM.

import { EXTENTS } from "../layers/splat_fill";

/** How the model is drawn. */
export interface Quality {
  /** Square of the radius at which splats are cut off, standard deviations. */
  maxReach: number;
  viewportScale: number;
  /** 0 to 1. */
  foveation: number;
  /** Fraction of the splats that are drawn. */
  share: number;
  /** Whether pictures of the server take the place of the splats. */
  usesServer: boolean;
}

const FULL: Quality = { maxReach: EXTENTS[0]!, viewportScale: 1, foveation: 0, share: 1, usesServer: false };

/** From the best to the cheapest. Each one changes one quantity of the previous one. */
export const LADDER: readonly Quality[] = [
  FULL,
  { ...FULL, maxReach: EXTENTS[1]! },
  { ...FULL, maxReach: EXTENTS[2]! },
  { ...FULL, maxReach: EXTENTS[3]! },
  { ...FULL, maxReach: EXTENTS[3]!, viewportScale: 0.85 },
  { ...FULL, maxReach: EXTENTS[3]!, viewportScale: 0.7 },
  { ...FULL, maxReach: EXTENTS[3]!, viewportScale: 0.7, foveation: 0.5 },
  { ...FULL, maxReach: EXTENTS[3]!, viewportScale: 0.7, foveation: 1 },
  { ...FULL, maxReach: EXTENTS[3]!, viewportScale: 0.7, foveation: 1, share: 0.7 },
  { ...FULL, maxReach: EXTENTS[3]!, viewportScale: 0.7, foveation: 1, share: 0.5 },
  { ...FULL, maxReach: EXTENTS[3]!, viewportScale: 0.7, foveation: 1, share: 0.35 },
  { ...FULL, maxReach: EXTENTS[3]!, viewportScale: 0.7, foveation: 1, share: 0.35, usesServer: true },
];

/** Full foveation saves this fraction of the shading of an eye buffer. An estimate, which measured frame times correct. */
const FOVEATION_SAVES = 0.4;

/**
 * Covered pixels per second of a Quest 3 with which the governor begins; measured frame times correct it. An estimate: a
 * native viewer drew 286,000 splats in 27.8 ms, of which 80 % were fill (Unity splat viewer, no figures of covered pixels).
 * With 40 pixels per splat and two eyes, that is 2 * 286e3 * 40 / (0.8 * 27.8e-3 s).
 */
export const QUEST_3_PX_PER_SEC = 1.0e9;
/** Fraction of a frame that the splats may take. The rest is for the compositor, the robot and the page. */
const FILL_SHARE = 0.7;
/** A frame was missed if it took longer than this many periods. */
const MISSED = 1.5;
/** After a missed frame, the budget shrinks by this, at most once in `SETTLE_MILLIS`, so that a change can act first. */
const SHRINK = 0.8;
const SETTLE_MILLIS = 150;
/**
 * The budget grows by this after so many milliseconds without a missed frame. If a growth leads to a missed frame, the next
 * one waits twice as long.
 */
const GROW = 1.15;
const GROW_MILLIS = 400;
const MAX_GROW_MILLIS = 6400;
/** A missed frame so soon after a growth is its consequence. */
const BLAME_MILLIS = 1000;
/** Better quality waits for this long, so that it does not change with each motion of the head. */
const UP_MILLIS = 300;
/** Better quality must fit into this fraction of the budget. */
const UP_FIT = 0.85;
/** The budget stays within these multiples of the published figure: browsers pause, and faster headsets exist. */
const BUDGET_LIMITS = [0.02, 20] as const;
/** Frames after a pause of this length say nothing about the load. */
const PAUSE_MILLIS = 1000;

/** Covered pixels per eye at a quality. `coveredPx`: by extent, at the full viewport; see `FillSum`. */
export function predictedPx(coveredPx: readonly number[], quality: Quality): number {
  if (quality.usesServer) return 0;
  const covered = coveredPx[EXTENTS.indexOf(quality.maxReach)] ?? 0;
  return covered * quality.viewportScale ** 2 * (1 - FOVEATION_SAVES * quality.foveation) * quality.share;
}

export class Governor {
  private coveredPx: readonly number[] = EXTENTS.map(() => 0);
  private level = 0;
  private budgetPx: number;
  private readonly publishedPx: number;
  private framesAt: number | null = null;
  private shrunkAt = -Infinity;
  private missedAt = -Infinity;
  private grownAt = 0;
  private growMillis = GROW_MILLIS;
  private fitsSince: number | null = null;
  private readonly periodMillis: number;
  /** The quality that the operator has chosen instead; null if the governor chooses. */
  fixed: number | null = null;

  /** `rateHz`: frame rate of the headset. */
  constructor(rateHz: number) {
    this.periodMillis = 1000 / rateHz;
    this.publishedPx = (FILL_SHARE * QUEST_3_PX_PER_SEC) / rateHz / 2;
    this.budgetPx = this.publishedPx;
  }

  get quality(): Quality {
    return LADDER[this.fixed ?? this.level]!;
  }

  /** Number of the quality in the ladder. */
  get step(): number {
    return this.fixed ?? this.level;
  }

  /** Covered pixels per eye that the headset is believed to draw in time. */
  get budget(): number {
    return this.budgetPx;
  }

  /** Covered pixels per eye at the present quality. */
  get fill(): number {
    return predictedPx(this.coveredPx, this.quality);
  }

  /** Adopts the covered pixels of the newest order of the splats. */
  setCovered(coveredPx: readonly number[]): void {
    this.coveredPx = coveredPx;
  }

  /** Called for each frame, with its time. */
  frame(nowMillis: number): void {
    const gap = this.framesAt === null ? null : nowMillis - this.framesAt;
    this.framesAt = nowMillis;
    if (gap === null || gap > PAUSE_MILLIS) {
      this.grownAt = nowMillis;
      return;
    }
    if (gap > MISSED * this.periodMillis) this.missed(nowMillis);
    else if (nowMillis - Math.max(this.missedAt, this.grownAt) > this.growMillis) this.grow(nowMillis);
    this.choose(nowMillis);
  }

  private missed(nowMillis: number): void {
    this.missedAt = nowMillis;
    if (nowMillis - this.shrunkAt < SETTLE_MILLIS) return;
    this.shrunkAt = nowMillis;
    if (nowMillis - this.grownAt < BLAME_MILLIS) this.growMillis = Math.min(MAX_GROW_MILLIS, 2 * this.growMillis);
    // What was drawn is too much, whatever was believed before.
    const drawn = this.fill > 0 ? this.fill : this.budgetPx;
    this.budgetPx = Math.max(BUDGET_LIMITS[0] * this.publishedPx, SHRINK * Math.min(this.budgetPx, drawn));
  }

  /** Learns that more may be possible, but only from frames that used most of the budget or were limited by it. */
  private grow(nowMillis: number): void {
    // A growth that has caused no missed frame was right.
    if (nowMillis - this.missedAt > 2 * this.growMillis) this.growMillis = GROW_MILLIS;
    this.grownAt = nowMillis;
    // Pictures of the server say nothing about splats: the budget grows only as slowly as after failures.
    if (this.quality.usesServer) this.growMillis = MAX_GROW_MILLIS;
    if (this.level === 0 && this.fill < 0.5 * this.budgetPx && this.budgetPx >= this.publishedPx) return;
    this.budgetPx = Math.min(BUDGET_LIMITS[1] * this.publishedPx, GROW * this.budgetPx);
  }

  private choose(nowMillis: number): void {
    const fitting = LADDER.findIndex((quality) => predictedPx(this.coveredPx, quality) <= this.budgetPx);
    const wanted = fitting < 0 ? LADDER.length - 1 : fitting;
    if (wanted > this.level) {
      this.level = wanted;
      this.fitsSince = null;
      return;
    }
    const better = LADDER.findIndex((quality) => predictedPx(this.coveredPx, quality) <= UP_FIT * this.budgetPx);
    if (better < 0 || better >= this.level) {
      this.fitsSince = null;
      return;
    }
    this.fitsSince ??= nowMillis;
    if (nowMillis - this.fitsSince < UP_MILLIS) return;
    this.level = better;
    this.fitsSince = null;
  }
}

/** A quality in words. */
export function qualityText({ maxReach, viewportScale, foveation, share, usesServer }: Quality): string {
  if (usesServer) return "pictures of the server";
  const parts = [
    maxReach < EXTENTS[0]! ? `splats cut at ${Math.sqrt(maxReach).toFixed(1)} sigma` : "whole splats",
    ...(viewportScale < 1 ? [`${Math.round(100 * viewportScale)} % resolution`] : []),
    ...(foveation > 0 ? [`foveation ${Math.round(100 * foveation)} %`] : []),
    ...(share < 1 ? [`${Math.round(100 * share)} % of the splats`] : []),
  ];
  return parts.join(", ");
}

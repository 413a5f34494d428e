// The results of a study as text: a CSV file with one line per recorded value, and the values of its charts.

import type { BoxGroup } from "./box_plot";
import type { Study } from "./study_plan";
import type { Recorded } from "./study_session";

const COLUMNS = ["participant", "kind", "place", "condition", "item", "value", "outcome"] as const;

/** The CSV file (RFC 4180). */
export function csv(recorded: readonly Recorded[]): string {
  const lines = recorded.map((entry) => COLUMNS.map((column) => cell(entry[column])).join(","));
  return [COLUMNS.join(","), ...lines].map((line) => `${line}\r\n`).join("");
}

/** Text as a cell. Spreadsheets would run texts that begin like formulas. */
function cell(value: string | number | null): string {
  if (value === null) return "";
  if (typeof value === "number") return String(value);
  const text = /^[=+\-@\t\r]/.test(value) ? `'${value}` : value;
  return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}

/** The ratings of each statement, by condition. */
export function ratingGroups({ statements, conditions }: Study, recorded: readonly Recorded[]): BoxGroup[] {
  return statements.map(({ id }) => ({ label: id, boxes: conditions.map((condition) => valuesOf(recorded, "rating", id, condition.id)) }));
}

/** The durations of each task, by condition, seconds. Tasks that were given up do not count, and those out of time count in full. */
export function durationGroups({ tasks, conditions }: Study, recorded: readonly Recorded[]): BoxGroup[] {
  const ended = recorded.filter(({ outcome }) => outcome !== "given up");
  return tasks.map(({ id, title }) => ({ label: title, boxes: conditions.map((condition) => valuesOf(ended, "task", id, condition.id)) }));
}

function valuesOf(recorded: readonly Recorded[], kind: Recorded["kind"], item: string, condition: string): number[] {
  return recorded
    .filter((entry) => entry.kind === kind && entry.item === item && entry.condition === condition)
    .map(({ value }) => Number(value));
}

// One participant's way through a study: which step comes next, and what was recorded. It has no clock and no elements of the page.

import { balancedOrder, taskOrder } from "./order";
import type { Condition, Study, Task } from "./study_plan";

export type Outcome = "done" | "given up" | "out of time";

/** What was recorded, one entry per line of the CSV file. */
export interface Recorded {
  /** Number of the participant, counted from 1. */
  participant: number;
  kind: "background" | "task" | "rating" | "preference";
  /** Place of the condition in the participant's order, counted from 1, and its id. Empty for the background. */
  place: number | null;
  condition: string;
  /** Id of the question, the task or the statement. */
  item: string;
  /** Duration in seconds, rating, or answer. */
  value: string | number;
  outcome: Outcome | "";
}

export type Step =
  | { kind: "background" }
  | { kind: "condition"; place: number; condition: Condition }
  | { kind: "task"; place: number; condition: Condition; task: Task; taskPlace: number }
  | { kind: "rating"; place: number; condition: Condition }
  | { kind: "preference" }
  | { kind: "end" };

/** The part of a session that survives a reload of the page. */
export interface SavedSession {
  participant: number;
  step: number;
  recorded: Recorded[];
}

export class StudySession {
  readonly steps: readonly Step[];
  private ix = 0;
  private readonly records: Recorded[] = [];

  /** `participant` is counted from 1. */
  constructor(
    readonly study: Study,
    readonly participant: number,
  ) {
    this.steps = stepsOf(study, participant);
  }

  /** Continues a session. Null if it belongs to another study. */
  static restored(study: Study, saved: SavedSession): StudySession | null {
    const session = new StudySession(study, saved.participant);
    if (!session.steps[saved.step]) return null;
    session.ix = saved.step;
    session.records.push(...saved.recorded);
    return session;
  }

  get saved(): SavedSession {
    return { participant: this.participant, step: this.ix, recorded: [...this.records] };
  }

  get step(): Step {
    return this.steps[this.ix]!;
  }

  get recorded(): readonly Recorded[] {
    return this.records;
  }

  /** The answers to questions about the participant; empty ones are left out. */
  background(answers: Readonly<Record<string, string>>): void {
    this.expect("background");
    for (const [item, value] of Object.entries(answers)) if (value !== "") this.record({ kind: "background", item, value });
    this.ix += 1;
  }

  /** The participant sees the condition. */
  begin(): void {
    this.expect("condition");
    this.ix += 1;
  }

  /** The present task has ended. */
  endTask(secs: number, outcome: Outcome): void {
    const step = this.expect("task");
    if (!(secs >= 0)) throw new Error(`a task of ${secs} s`);
    const value = Number(Math.min(secs, step.task.limit_s).toFixed(2));
    this.record({ kind: "task", ...at(step), item: step.task.id, value, outcome });
    this.ix += 1;
  }

  /** Ratings by statement. All are needed. */
  rate(ratings: Readonly<Record<string, number>>): void {
    const step = this.expect("rating");
    const { statements, scale } = this.study;
    const isValid = (rating: number | undefined): boolean => rating !== undefined && Number.isInteger(rating) && rating >= 1 && rating <= scale;
    if (!statements.every(({ id }) => isValid(ratings[id]))) throw new Error("a statement has no rating");
    for (const { id } of statements) this.record({ kind: "rating", ...at(step), item: id, value: ratings[id]! });
    this.ix += 1;
  }

  /** The condition that the participant would choose. */
  prefer(condition: string): void {
    this.expect("preference");
    if (!this.study.conditions.some(({ id }) => id === condition)) throw new Error(`no condition ${condition}`);
    this.record({ kind: "preference", condition, item: "choice", value: 1 });
    this.ix += 1;
  }

  private expect<K extends Step["kind"]>(kind: K): Extract<Step, { kind: K }> {
    const { step } = this;
    if (step.kind !== kind) throw new Error(`the step is ${step.kind}, not ${kind}`);
    return step as Extract<Step, { kind: K }>;
  }

  private record(entry: Omit<Recorded, "participant" | "place" | "condition" | "outcome"> & Partial<Recorded>): void {
    this.records.push({ place: null, condition: "", outcome: "", ...entry, participant: this.participant });
  }
}

function stepsOf({ conditions, tasks }: Study, participant: number): Step[] {
  const order = balancedOrder(conditions.length, participant - 1);
  const steps: Step[] = [{ kind: "background" }];
  for (const [ix, which] of order.entries()) {
    const common = { place: ix + 1, condition: conditions[which]! };
    steps.push({ kind: "condition", ...common });
    for (const [taskIx, task] of taskOrder(tasks.length, participant - 1, ix).entries()) {
      steps.push({ kind: "task", ...common, task: tasks[task]!, taskPlace: taskIx + 1 });
    }
    steps.push({ kind: "rating", ...common });
  }
  return [...steps, { kind: "preference" }, { kind: "end" }];
}

function at({ place, condition }: { place: number; condition: Condition }): { place: number; condition: string } {
  return { place, condition: condition.id };
}

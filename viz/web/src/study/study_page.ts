// The study: a panel with which an experimenter leads participants through conditions and tasks. It is loaded if the address of the
// page ends with ?study. Results stay in the storage of this browser until the experimenter saves them as files.

import { download } from "../panels/download";
import { child, make } from "../panels/html";
import { store, stored } from "../panels/storage";
import type { ViewMemory } from "../view/view_memory";
import { boxPlot } from "./box_plot";
import { DEFAULT_STUDY, MAX_BYTES, type Condition, type Study, studyIn } from "./study_plan";
import { csv, durationGroups, ratingGroups } from "./study_results";
import { type Outcome, type Recorded, type SavedSession, type Step, StudySession } from "./study_session";

/** What the study needs from the rest of the page. */
export interface StudyParts {
  memory: ViewMemory;
  /** Shows the first view, so that each task begins at the same place. */
  resetView: () => void;
  /** Methods of the models that the server has. */
  methods: () => string[];
  /** Shows a message. */
  say: (text: string) => void;
}

const STORED_KEY = "study";
const TIMER_MILLIS = 200;
/** The axis of the times ends at a multiple of this, so that its ticks are round. */
const AXIS_STEP_S = 20;
/** Questions about the participant, as the paper reports the answers. All are optional. */
const BACKGROUND: readonly [id: string, question: string][] = [
  ["age", "Age"],
  ["gender", "Gender"],
  ["robots", "How often do you work with robots?"],
  ["headsets", "How often have you used a headset?"],
];

/** What is stored between two visits. */
interface Stored {
  /** Text of the study file; null for the study of the paper. */
  file: string | null;
  /** Results of the participants that have finished. */
  recorded: Recorded[];
  /** The participant who has not finished. */
  session: SavedSession | null;
}

export class StudyPage {
  private readonly root = make("section", { id: "study", className: "panel study", ariaLabel: "Study" });
  private kept: Stored = { file: null, recorded: [], session: null };
  private study: Study = DEFAULT_STUDY;
  private session: StudySession | null = null;
  /** Time at which the present task began; null before it. */
  private begunAt: number | null = null;

  constructor(
    parent: HTMLElement,
    private readonly parts: StudyParts,
  ) {
    parent.append(this.root);
    this.restore();
    window.setInterval(() => this.tick(), TIMER_MILLIS);
    this.draw();
  }

  private restore(): void {
    try {
      const kept = JSON.parse(stored(STORED_KEY) ?? "null") as Stored | null;
      if (!kept) return;
      const study = kept.file === null ? DEFAULT_STUDY : studyIn(kept.file);
      if (typeof study === "string") return;
      this.session = kept.session && StudySession.restored(study, kept.session);
      [this.kept, this.study] = [kept, study];
    } catch {
      this.parts.say("The stored results of the study cannot be read, so the study begins again");
    }
  }

  private keep(): void {
    this.kept.session = this.session?.saved ?? null;
    if (!store(STORED_KEY, JSON.stringify(this.kept))) {
      this.parts.say("The browser stores nothing for this page: save the results before you close it");
    }
  }

  private draw(): void {
    this.begunAt = null;
    const { session } = this;
    this.root.dataset.step = session?.step.kind ?? "setup";
    this.root.replaceChildren(...(session ? this.stepElements(session, session.step) : this.setup()));
    this.root.querySelector<HTMLElement>("input, button")?.focus({ preventScroll: true });
  }

  private stepElements(session: StudySession, step: Step): HTMLElement[] {
    switch (step.kind) {
      case "background":
        return this.background(session);
      case "condition":
        return this.condition(session, step);
      case "task":
        return this.task(session, step);
      case "rating":
        return this.rating(session, step.condition);
      case "preference":
        return this.preference(session);
      case "end":
        return this.end(session);
    }
  }

  /** The experimenter chooses the participant, or saves results. */
  private setup(): HTMLElement[] {
    const { conditions, tasks, title } = this.study;
    const nFinished = new Set(this.kept.recorded.map(({ participant }) => participant)).size;
    const next = Math.max(0, ...this.kept.recorded.map(({ participant }) => participant)) + 1;
    const number = make("input", { id: "study-participant", type: "number", min: "1", max: "999", value: String(next), required: true });
    const form = make("form", { className: "study-row" });
    form.append(labeled("Participant", number), make("button", { id: "study-begin", textContent: "Begin" }));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.session = new StudySession(this.study, number.valueAsNumber);
      this.next();
    });
    const file = make("input", { id: "study-file", type: "file", accept: ".json,application/json" });
    file.addEventListener("change", () => void this.open(file.files?.[0]));
    const list = make("ol");
    list.append(...conditions.map(({ label }) => child("li", label)));
    const results = make("p", { className: "study-row" });
    results.append(
      child("span", nFinished === 1 ? "1 participant has finished." : `${nFinished} participants have finished.`),
      button("study-csv", "Save CSV", () => this.save("csv"), nFinished > 0),
      button("study-ratings", "Save box plot of ratings", () => this.save("ratings"), nFinished > 0),
      button("study-times", "Save box plot of times", () => this.save("times"), nFinished > 0),
      button("study-delete", "Delete results", () => this.deleteResults(), nFinished > 0),
    );
    return [
      child("h2", `Study: ${title}`),
      child("p", `${conditions.length} conditions with ${tasks.length} tasks each, in an order that depends on the participant:`),
      list,
      form,
      results,
      labeled("Open a study file", file),
      child("p", "Results stay in this browser."),
    ];
  }

  private background(session: StudySession): HTMLElement[] {
    const inputs = BACKGROUND.map(([id]) => make("input", { id: `study-${id}`, name: id, maxLength: 60, autocomplete: "off" }));
    const rows = BACKGROUND.map(([, question], ix) => labeled(question, inputs[ix]!));
    return [
      child("h2", `Participant ${session.participant}`),
      child("p", "You may leave out any of these."),
      this.form(rows, () => session.background(Object.fromEntries(inputs.map(({ name, value }) => [name, value.trim()])))),
    ];
  }

  private condition(session: StudySession, { place, condition }: Extract<Step, { kind: "condition" }>): HTMLElement[] {
    const elements = [
      child("h2", `View ${place} of ${session.study.conditions.length}: ${condition.label}`),
      child("p", condition.display === "screen" ? "Try the view until you can move it. Then begin." : headsetText(condition)),
    ];
    const problem = condition.display === "screen" ? this.showCondition(condition) : null;
    if (problem) elements.push(make("p", { className: "study-problem", textContent: problem }));
    return [...elements, this.form([], () => session.begin(), "Begin the tasks")];
  }

  /** Shows the model of a condition. Returns the reason if the server does not have it. */
  private showCondition({ model, mode }: Condition): string | null {
    const methods = this.parts.methods();
    if (!methods.includes(model)) {
      return `This server has no model of the method ${model}, only ${methods.join(", ") || "none"}: this condition cannot be shown`;
    }
    this.parts.memory.change({ method: model, switches: { local: mode === "direct", model: true } });
    return null;
  }

  private task(session: StudySession, step: Extract<Step, { kind: "task" }>): HTMLElement[] {
    const { task, taskPlace, condition } = step;
    if (condition.display === "screen") {
      this.showCondition(condition);
      this.parts.resetView();
    }
    const time = make("output", { id: "study-time", textContent: `0 of ${task.limit_s} s` });
    const end = (outcome: Outcome): void => this.endTask(outcome);
    const endings = [
      button("study-done", "Done", () => end("done"), false),
      button("study-give-up", "Give up", () => end("given up"), false),
    ];
    const start = button("study-start", "Start", () => {
      this.begunAt = performance.now();
      start.disabled = true;
      for (const ending of endings) ending.disabled = false;
      endings[0]!.focus();
    });
    const row = make("p", { className: "study-row" });
    row.append(start, ...endings, time);
    return [child("h2", `Task ${taskPlace} of ${session.study.tasks.length}: ${task.title}`), child("p", task.text), row];
  }

  private endTask(outcome: Outcome): void {
    if (this.begunAt === null || !this.session) return;
    this.session.endTask((performance.now() - this.begunAt) / 1000, outcome);
    this.next();
  }

  private tick(): void {
    const step = this.session?.step;
    const time = document.getElementById("study-time");
    if (this.begunAt === null || step?.kind !== "task" || !time) return;
    const secs = (performance.now() - this.begunAt) / 1000;
    time.textContent = `${Math.floor(secs)} of ${step.task.limit_s} s`;
    if (secs >= step.task.limit_s) this.endTask("out of time");
  }

  private rating(session: StudySession, condition: Condition): HTMLElement[] {
    const { statements, scale } = session.study;
    const rows = statements.map(({ id, text }) => {
      const field = make("fieldset");
      const points = Array.from({ length: scale }, (_, ix) => {
        const input = make("input", { type: "radio", name: `study-${id}`, value: String(ix + 1), required: true });
        const label = make("label");
        label.append(input, String(ix + 1));
        return label;
      });
      field.append(child("legend", text), ...points);
      return field;
    });
    const form = this.form(rows, () => {
      const values = new FormData(form);
      session.rate(Object.fromEntries(statements.map(({ id }) => [id, Number(values.get(`study-${id}`))])));
    });
    return [child("h2", condition.label), child("p", `1: I disagree, ${scale}: I agree`), form];
  }

  private preference(session: StudySession): HTMLElement[] {
    const choice = make("select", { id: "study-choice", required: true });
    choice.append(new Option("", ""), ...session.study.conditions.map(({ id, label }) => new Option(label, id)));
    return [
      child("h2", "Which view would you choose for your work?"),
      this.form([labeled("View", choice)], () => session.prefer(choice.value)),
    ];
  }

  private end(session: StudySession): HTMLElement[] {
    const { participant } = session;
    // A participant who is repeated replaces the earlier results.
    this.kept.recorded = [...this.kept.recorded.filter((entry) => entry.participant !== participant), ...session.recorded];
    this.session = null;
    this.keep();
    const again = button("study-next", "Next participant", () => this.draw());
    return [child("h2", `Thank you, participant ${participant}`), again];
  }

  /** A form with a button that goes to the next step. */
  private form(rows: HTMLElement[], submit: () => void, label = "Continue"): HTMLFormElement {
    const form = make("form");
    const row = make("p", { className: "study-row" });
    row.append(make("button", { id: "study-continue", textContent: label }));
    form.append(...rows, row);
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      submit();
      this.next();
    });
    return form;
  }

  private next(): void {
    this.keep();
    this.draw();
  }

  private async open(file: File | undefined): Promise<void> {
    if (!file) return;
    const text = await file.slice(0, 4 * MAX_BYTES).text();
    const study = studyIn(text);
    if (typeof study === "string") {
      this.parts.say(`${file.name} cannot be opened: ${study}`);
      return;
    }
    if (this.kept.recorded.length > 0) {
      this.parts.say("Save and delete the results of the present study first");
      return;
    }
    this.study = study;
    this.kept.file = text;
    this.next();
  }

  private save(what: "csv" | "ratings" | "times"): void {
    const { recorded } = this.kept;
    if (what === "csv") download(new Blob([csv(recorded)], { type: "text/csv" }), "study.csv");
    else download(new Blob([what === "ratings" ? this.ratingsPlot() : this.timesPlot()], { type: "image/svg+xml" }), `study-${what}.svg`);
  }

  private ratingsPlot(): string {
    const { title, scale } = this.study;
    const groups = ratingGroups(this.study, this.kept.recorded);
    return boxPlot({ title: `${title}: ratings`, axis: "rating", legend: this.labels, groups, range: [1, scale] });
  }

  private timesPlot(): string {
    const groups = durationGroups(this.study, this.kept.recorded);
    const longest = Math.max(0, ...groups.flatMap(({ boxes }) => boxes.flat()));
    const range: [number, number] = [0, Math.max(AXIS_STEP_S, AXIS_STEP_S * Math.ceil(longest / AXIS_STEP_S))];
    return boxPlot({ title: `${this.study.title}: times`, axis: "time (s)", legend: this.labels, groups, range });
  }

  private get labels(): string[] {
    return this.study.conditions.map(({ label }) => label);
  }

  private deleteResults(): void {
    if (!window.confirm("Delete the results of all participants from this browser?")) return;
    this.kept = { file: this.kept.file, recorded: [], session: null };
    this.next();
  }
}

function headsetText({ label, model }: Condition): string {
  return `Put on the headset and choose there: ${label} (model ${model}). Try the view until you can move it. Then begin.`;
}

function button(id: string, textContent: string, act: () => void, isEnabled = true): HTMLButtonElement {
  const made = make("button", { id, textContent, type: "button", disabled: !isEnabled });
  made.addEventListener("click", act);
  return made;
}

function labeled(text: string, control: HTMLElement): HTMLLabelElement {
  const label = make("label", { className: "study-label" });
  label.append(child("span", text), control);
  return label;
}

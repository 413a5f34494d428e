// Incidents of a steered run that has ended: a list, and the robot and its target at the time of the chosen one.

import { Matrix4, Vector3 } from "three";
import type { RobotState } from "../connection/protocol";
import { element } from "../panels/element";
import { child, make, setText } from "../panels/html";
import { capitalized, reasonOf } from "../panels/sentence";
import { Ghost, type GhostParts } from "../steering/ghost";
import { isApart } from "../steering/ghost_looks";
import { Marks } from "../steering/marks";
import { poseOf } from "../steering/pose";
import type { OrbitView } from "../view/orbit_view";
import {
  clockText,
  type Incident,
  type IncidentList,
  kindText,
  lackText,
  modelText,
  parseIncidents,
  type PoseNumbers,
  positionsFor,
  type Sample,
  samplesAround,
  timeText,
} from "./incident_list";

/** Labels at places have the signs of limits. */
const EFFECTS: Partial<Record<Incident["kind"], string>> = { slowed: "slowed", refused: "refused" };

export interface IncidentParts extends GhostParts {
  view: OrbitView;
}

export class Incidents {
  private readonly view: OrbitView;
  private readonly ghost: Ghost;
  private readonly marks: Marks;
  private readonly panel = element("incidents");
  private readonly list = make("ol", { className: "incident-list" });
  private readonly chosenText = element("incident-text");
  private readonly look = make("button", { textContent: "Look as the operator", hidden: true });
  private readonly slider = make("input", { type: "range", min: "0", hidden: true, ariaLabel: "Time around the incident" });
  private samples: readonly Sample[] = [];
  private path = "";
  private found: IncidentList | null = null;
  private chosen: Incident | null = null;

  constructor(page: IncidentParts) {
    const { view } = page;
    this.view = view;
    const changed = (): void => view.changed();
    const canvas = element("canvas", HTMLCanvasElement);
    this.ghost = new Ghost(view.robot, view.occlusion, page, changed);
    const labels = make("div", { className: "steer-marks", ariaHidden: "true" });
    element("steer-marks").after(labels); // Those of an arm that is steered are others.
    this.marks = view.addTool((ofView) => new Marks(ofView, canvas, changed, labels));
    view.addTool(() => ({ root: this.ghost.root, hasTakenPress: false, update: () => undefined }));
    this.look.title = "Look from where the operator looked at this time";
    this.look.addEventListener("click", () => this.lookAsOperator());
    this.slider.title = "Move the robot through the seconds around the incident";
    this.slider.addEventListener("input", () => this.showSample());
    this.panel.replaceChildren(this.chosenText, this.slider, this.look, this.list);
  }

  /** Loads the list at a path of the server. */
  async load(path: string): Promise<void> {
    if (path === this.path) return;
    this.path = path;
    setText(this.chosenText, "The steering log is being read …");
    try {
      const response = await fetch(path, { cache: "no-store" });
      if (!response.ok) throw new Error(await response.text());
      this.found = parseIncidents(await response.json());
      if (!this.found) throw new Error("the list is damaged");
      this.fill(this.found);
    } catch (error) {
      this.path = ""; // The next status tries again.
      setText(this.chosenText, `The incidents cannot be shown: ${reasonOf(error)}`);
    }
  }

  private fill(found: IncidentList): void {
    const rows = found.incidents.map((incident) => {
      const button = make("button", { title: clockText(found, incident) });
      button.dataset.kind = incident.kind;
      button.append(child("time", timeText(incident.seconds)), child("b", kindText(incident.kind)), child("span", capitalized(incident.text)));
      button.addEventListener("click", () => this.choose(incident, button));
      const row = make("li");
      row.append(button);
      return row;
    });
    this.list.replaceChildren(...rows);
    const hint = rows.length === 0 ? "Nothing happened while the arm was steered." : "Choose an incident to see the robot at that time.";
    setText(this.chosenText, `${hint} ${lackText(found)}`.trim());
  }

  private choose(incident: Incident, button: HTMLButtonElement): void {
    const { found } = this;
    if (!found) return;
    this.list.querySelector("[aria-current]")?.removeAttribute("aria-current");
    button.setAttribute("aria-current", "true");
    this.chosen = incident;
    this.look.hidden = incident.view === null;
    const { samples, ix } = samplesAround(found, incident);
    this.samples = samples;
    this.slider.hidden = samples.length < 2;
    this.slider.max = String(samples.length - 1);
    this.slider.value = String(ix);
    this.mark(found, incident);
    const isShown = this.pose(found, incident);
    const what = `${timeText(incident.seconds)}, ${clockText(found, incident)}. ${modelText(found, incident)}`;
    setText(this.chosenText, isShown ? what : `${what} The robot is not shown, because its description or its position is unknown.`);
  }

  private showSample(): void {
    const sample = this.samples[this.slider.valueAsNumber];
    if (!this.found || !this.chosen || !sample) return;
    this.pose(this.found, { ...this.chosen, ...sample });
    setText(this.chosenText, `${timeText(sample.seconds)}, ${modelText(this.found, { ...this.chosen, seconds: sample.seconds })}`);
  }

  /** Shows the place of the reason. */
  private mark(found: IncidentList, { kind, text, place }: Incident): void {
    const worldPoint = place && new Vector3(...place).applyMatrix4(matrixOf(found.worldFromBase));
    this.marks.show(worldPoint ? [{ worldPoint, effect: EFFECTS[kind] ?? "braked", text: capitalized(text) }] : []);
  }

  /** Shows the robot and its target; returns whether the robot is known. */
  private pose(found: IncidentList, { kind, position, target, worldFromBase: ofBase }: Incident): boolean {
    const { robot } = this.view;
    const worldFromBase = matrixOf(ofBase ?? found.worldFromBase);
    if (!robot.description || (position.length === 0 && !ofBase)) {
      this.ghost.hide();
      return false;
    }
    const state: RobotState = {
      type: "robot_state",
      stamp_nanos: 0,
      captured_millis: 0,
      world_from_base: worldFromBase.clone().transpose().elements, // three.js has columns.
      positions: positionsFor(robot.description.joint_names, found, position),
    };
    robot.setState(state);
    if (target && isApart(target, position)) this.ghost.show(found.jointNames, target, kind === "refused" ? "collision" : "reachable");
    else this.ghost.hide();
    this.view.changed();
    return true;
  }

  private lookAsOperator(): void {
    const view = this.chosen?.view;
    if (view) this.view.lookFrom(matrixOf(view).transpose().elements);
  }
}

function matrixOf(numbers: PoseNumbers): Matrix4 {
  const { position, rotation } = poseOf(numbers);
  return new Matrix4().compose(position, rotation, new Vector3(1, 1, 1));
}

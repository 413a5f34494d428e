// What the palm menu contains: texts and buttons of the page, which are pressed as on the page, and those that only a headset
// has.

import type { HandSteering } from "../steering/hand_steering";
import { LADDER, type Quality, qualityText } from "./governor";
import type { MenuButton, MenuContent } from "./menu_layout";

export type Tab = "view" | "layers" | "robot";

/** What only the headset knows. */
export interface MenuState {
  tab: Tab;
  quality: Quality;
  /** Number of the chosen quality in the ladder; null if the governor chooses. */
  fixedQuality: number | null;
  hasVignette: boolean;
  isLeftHanded: boolean;
  isPinned: boolean;
  showsImages: boolean;
  movesBox: boolean;
  steersByHand: boolean;
  placesGoal: boolean;
  drawnBy: "local" | "eyes" | "pictures" | "nothing";
  hasHandPicture: boolean;
  hasSphere: boolean;
}

/** Layers of the page that have a meaning in a headset, by the ids of their buttons. */
const LAYERS: readonly (readonly [id: string, label: string])[] = [
  ["toggle-model", "Model"],
  ["toggle-robot", "Robot"],
  ["toggle-points", "Points"],
  ["toggle-scans", "Scans"],
  ["toggle-keyframes", "Keyframes"],
  ["toggle-grid", "Grid"],
  ["toggle-frames", "Frames"],
  ["toggle-age", "Scene age"],
  ["toggle-uncertainty", "Uncertainty"],
  ["toggle-coverage", "Never seen"],
  ["toggle-crop", "Crop"],
];

/** The fixed qualities that can be chosen: the best one, a medium one, and pictures of the server. */
export const CHOICES: readonly { id: string; label: string; fixed: number | null }[] = [
  { id: "quality-auto", label: "Automatic", fixed: null },
  { id: "quality-full", label: "Full", fixed: 0 },
  { id: "quality-half", label: "Fast", fixed: 5 },
  { id: "quality-server", label: "Server", fixed: LADDER.length - 1 },
];

export function menuContent(state: MenuState, steering: HandSteering | null): MenuContent {
  const tabs: MenuButton[] = (["view", "layers", "robot"] as const).map((tab) => ({
    id: `tab-${tab}`,
    label: tab[0]!.toUpperCase() + tab.slice(1),
    isOn: tab === state.tab,
  }));
  const stop = steering?.canMove ? [{ id: "page steer-stop", label: "STOP THE ROBOT", isStop: true, span: 3 }] : [];
  const content = state.tab === "view" ? viewGroups(state) : state.tab === "layers" ? layerGroups(state) : robotGroups(state, steering);
  return {
    lines: statusLines(state, steering),
    groups: [
      { title: "", buttons: [...stop, ...tabs] },
      ...content,
      { title: "", buttons: [switchOf("pin", "Pin menu", state.isPinned), { id: "leave", label: "Leave", span: 2 }] },
    ],
  };
}

/** Ages, latency and control as on the page, and how the headset draws. */
function statusLines(state: MenuState, steering: HandSteering | null): string[] {
  const drawnBy = {
    local: qualityText(state.quality),
    eyes: "a picture of the server for each eye",
    pictures: "pictures of the server, the same for both eyes",
    nothing: "no model yet",
  };
  const picture = [textOf("picture-text"), textOf("local-text")].filter((text) => text !== "").join(", ");
  const who = steering ? textOf("steer-lease") : "";
  return [
    textOf("connection"),
    picture,
    [textOf("shown-text"), textOf("robot-age")].filter((text) => text !== "").join(", "),
    `Drawn: ${drawnBy[state.drawnBy]}`,
    who,
  ].filter((text) => text !== "");
}

function viewGroups(state: MenuState): MenuContent["groups"] {
  return [
    {
      title: "Place",
      buttons: [
        { id: "place-table", label: "Table" },
        { id: "place-full", label: "Full size" },
        { id: "place-robot", label: "At the robot" },
        { id: "higher", label: "Higher" },
        { id: "lower", label: "Lower" },
        switchOf("images", "Cameras", state.showsImages),
      ],
    },
    { title: "Quality", buttons: CHOICES.map(({ id, label, fixed }) => switchOf(id, label, fixed === state.fixedQuality)) },
    {
      title: "Pictures of the server",
      buttons: [
        switchOf("hand-picture", "In the hand", state.hasHandPicture),
        switchOf("sphere", "Around me", state.hasSphere),
        { id: "sharper", label: "Sharper" },
        ...(state.hasHandPicture ? [{ id: "zoom-in", label: "Zoom in" }, { id: "zoom-out", label: "Zoom out" }] : []),
        ...(state.hasSphere ? [{ id: "fade-sphere", label: "Fade" }] : []),
      ],
    },
    {
      title: "Comfort",
      buttons: [
        switchOf("vignette", "Vignette", state.hasVignette),
        switchOf("left-handed", "Left hand", state.isLeftHanded),
      ],
    },
  ];
}

function layerGroups(state: MenuState): MenuContent["groups"] {
  const layers = LAYERS.flatMap(([id, label]) => pageButton(id, label));
  const box = isOn("toggle-crop") ? [switchOf("move-box", "Move the box", state.movesBox)] : [];
  const models = [...document.querySelectorAll<HTMLElement>("#models [data-method]")].map((button) => ({
    id: `model ${button.dataset.method!}`,
    label: button.textContent ?? "",
    isOn: button.ariaPressed === "true",
  }));
  return [
    { title: "Model", buttons: models },
    { title: "Layers", buttons: [...layers, ...box] },
  ];
}

function robotGroups(state: MenuState, steering: HandSteering | null): MenuContent["groups"] {
  if (!steering) return [{ title: "This server has no robot that can be steered", buttons: [] }];
  const control = steering.hasControl ? pageButton("steer-release", "Give back") : pageButton("steer-take", "Take control");
  const permit = textOf("steer-stop-text") === "" ? [] : pageButton("steer-rearm", textOf("steer-rearm"), 2);
  const byHand = steering.isBase
    ? switchOf("place-goal", "Place a goal", state.placesGoal)
    : switchOf("steer-hand", "Steer by hand", state.steersByHand);
  const goal = steering.hasGoal
    ? [
        { id: "go", label: "Hold to go", isDisabled: !steering.mayGo },
        { id: "discard", label: "Discard" },
      ]
    : [];
  const lines = [textOf("steer-mode"), textOf("steer-verdict"), textOf("steer-stop-text"), textOf("steer-note")];
  return [
    { title: lines.filter((text) => text !== "").join(". "), buttons: [...control, ...permit, ...(steering.hasControl ? [byHand, ...goal] : [])] },
  ];
}

function switchOf(id: string, label: string, isPressed: boolean): MenuButton {
  return { id, label, isOn: isPressed };
}

/** A button of the page, if the page shows it. */
function pageButton(id: string, label: string, span = 1): MenuButton[] {
  const button = document.getElementById(id) as HTMLButtonElement | null;
  if (!button || button.hidden) return [];
  const pressed = button.getAttribute("aria-pressed");
  const isSwitch = pressed === null ? {} : { isOn: pressed === "true" };
  return [{ id: `page ${id}`, label, isDisabled: button.disabled, span, ...isSwitch }];
}

function isOn(id: string): boolean {
  return document.getElementById(id)?.getAttribute("aria-pressed") === "true";
}

/** The text of an element of the page; empty if it is hidden. */
function textOf(id: string): string {
  const found = document.getElementById(id);
  return found && !found.hidden ? (found.textContent ?? "").trim() : "";
}

/** Presses a button of the page or of a model. Returns whether the id is one. */
export function pressPageButton(id: string): boolean {
  const [kind, name] = id.split(" ") as [string, string | undefined];
  if (name === undefined) return false;
  if (kind === "page") document.getElementById(name)?.click();
  if (kind === "model") document.querySelector<HTMLElement>(`#models [data-method="${name}"]`)?.click();
  return kind === "page" || kind === "model";
}

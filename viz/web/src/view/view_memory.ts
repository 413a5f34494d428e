// Keeps the view across a reload of the page, in the address, and in links. The view consists of
// the camera, the drawn layers, the crop box, the chosen model and the camera path.

import * as THREE from "three";
import type { ModelSwitch } from "../panels/model_switch";
import type { OrbitView } from "./orbit_view";
import { decoded, encoded, fragmentWith, linkTo, type Remembered, textInFragment } from "./remembered";
import { store, stored } from "../panels/storage";
import type { ViewSettings } from "./view_settings";

const STORED_KEY = "view";
/** Minimum time between two changes of the address. Safari allows 100 changes in 30 s. */
const WRITE_MILLIS = 1000;
/**
 * The switches that are remembered. They choose what is drawn, and do not include tools such as the
 * measurement. A cut is not remembered, because it ends with its view.
 */
const SWITCHES = ".layers [id^=toggle-][aria-pressed]:not(#toggle-cut), #toggle-crop";
const TOGGLE = "toggle-";

/** What is shown. */
export interface ShownState extends Omit<Remembered, "switched"> {
  /** The switches by name, such as `grid`, and whether they are on. */
  switches: Record<string, boolean>;
}

export class ViewMemory {
  /** The switches that are pressed initially. */
  private readonly initiallyOn = new Set(switches().filter(isOn).map((button) => button.id));
  /** Whether the user has acted. Before that, the address is not changed. */
  private hasUserActed = false;
  private written: string | null = null;
  /** Whether the page began with a view of its address or of an earlier load. */
  private hasEarlierView = false;

  constructor(
    private readonly view: OrbitView,
    private readonly settings: ViewSettings,
    private readonly models: ModelSwitch,
  ) {
    for (const kind of ["pointerdown", "wheel", "keydown", "click"] as const) {
      window.addEventListener(kind, () => (this.hasUserActed = true), { capture: true, passive: true });
    }
    window.setInterval(() => this.write(), WRITE_MILLIS);
    window.addEventListener("pagehide", () => this.write());
    window.addEventListener("hashchange", () => this.show(textInFragment(location.hash)));
    const earlier = textAtStart();
    this.hasEarlierView = decoded(earlier ?? "") !== null;
    this.show(earlier);
  }

  /** Whether the view is the one with which every page begins. */
  get isUntouched(): boolean {
    return !this.hasEarlierView && !this.hasUserActed;
  }

  /** The present view, without the camera path, as text for [`show`]. */
  get viewText(): string {
    return encoded({ ...this.present, path: [] });
  }

  /** A link to the present view, which contains no token. */
  get link(): string {
    const { present } = this;
    const { view } = present;
    // An overview would follow the bounds of the model, and show another part of it later.
    return linkTo(location, encoded(view?.mode === "overview" ? { ...present, view: { ...view, mode: "orbit" } } : present));
  }

  /** Shows the view of an earlier text; does nothing if the text is not valid. */
  show(text: string | null): void {
    const remembered = decoded(text ?? "");
    if (!remembered) return;
    // Buttons that are pressed here do not count as an action of the user.
    const { hasUserActed } = this;
    this.restore(remembered);
    this.hasUserActed = hasUserActed;
    this.written = encoded(this.present);
    // The view is stored at once, because the page may be loaded again now, with a token that came
    // with the link.
    store(STORED_KEY, this.written, "sessionStorage");
  }

  /** What is shown now. */
  get state(): ShownState {
    const { view, crop, method, path } = this.present;
    return { view, crop, method, path, switches: Object.fromEntries(switches().map((button) => [nameOf(button), isOn(button)])) };
  }

  /** Shows the given parts. Other parts, and switches without a value, stay as they are. */
  change({ view, switches: wanted = {}, crop, method, path = [] }: Partial<ShownState>): void {
    if (method !== undefined) this.models.prefer(method);
    if (crop) this.view.crop.restore(crop);
    for (const button of switches()) {
      const isWanted = wanted[nameOf(button)];
      if (isWanted !== undefined) press(button, isWanted);
    }
    if (view) {
      // Flying changes the target, so it begins before the view is restored.
      press(document.getElementById(`${TOGGLE}fly`), view.mode === "fly");
      this.view.restore(view);
    }
    this.settings.restorePath(
      path.map(({ position, target, fovDegrees }) => ({
        position: new THREE.Vector3(...position),
        target: new THREE.Vector3(...target),
        fovDegrees,
      })),
    );
  }

  private get present(): Remembered {
    return {
      view: this.view.state(),
      switched: switches()
        .filter((button) => isOn(button) !== this.initiallyOn.has(button.id))
        .map(nameOf),
      crop: this.view.crop.changedBox,
      method: this.models.preferred,
      path: this.settings.pathViews.map(({ position, target, fovDegrees }) => ({
        position: position.toArray(),
        target: target.toArray(),
        fovDegrees,
      })),
    };
  }

  private restore({ switched, ...parts }: Remembered): void {
    const isSwitched = (button: HTMLElement): boolean => switched.includes(nameOf(button));
    const state = switches().map((button) => [nameOf(button), this.initiallyOn.has(button.id) !== isSwitched(button)]);
    this.change({ ...parts, switches: Object.fromEntries(state) as Record<string, boolean> });
  }

  /** Writes the view to the address and to the storage of the tab, if it has changed. */
  private write(): void {
    const text = encoded(this.present);
    if (!this.hasUserActed || text === this.written || this.settings.isPlaying) return;
    this.written = text;
    history.replaceState(history.state, "", location.pathname + location.search + fragmentWith(text));
    store(STORED_KEY, text, "sessionStorage");
  }
}

/** After a reload, the stored view, which may be newer than the address; otherwise, the view of the address. */
function textAtStart(): string | null {
  const [navigation] = performance.getEntriesByType("navigation") as PerformanceNavigationTiming[];
  const inAddress = textInFragment(location.hash);
  // An address that was typed again may lead to another run.
  return navigation?.type === "navigate" ? inAddress : (stored(STORED_KEY, "sessionStorage") ?? inAddress);
}

function switches(): HTMLElement[] {
  return [...document.querySelectorAll<HTMLElement>(SWITCHES)];
}

/** The name of a switch. */
function nameOf(button: HTMLElement): string {
  return button.id.slice(TOGGLE.length);
}

function isOn(button: HTMLElement): boolean {
  return button.getAttribute("aria-pressed") === "true";
}

function press(button: HTMLElement | null, on: boolean): void {
  if (button && isOn(button) !== on) button.click();
}

// The buttons that enter a headset, and the script for it, which is loaded only where there is one.

import { element } from "../panels/element";
import { reasonOf } from "../panels/sentence";
import { showToast } from "../panels/toast";
import { shareThree } from "../three_of_the_page";
import type { Headset, HeadsetParts } from "./headset";

/** A mode of a session, and its button. */
const MODES = [
  { mode: "immersive-vr", id: "enter-vr" },
  { mode: "immersive-ar", id: "enter-ar" },
] as const;
export type HeadsetMode = (typeof MODES)[number]["mode"];

export class HeadsetLoader {
  private headset: Promise<Headset> | null = null;
  private session: XRSession | null = null;

  constructor(private readonly parts: HeadsetParts) {
    void this.showButtons();
    navigator.xr?.addEventListener?.("devicechange", () => void this.showButtons());
    for (const { mode, id } of MODES) element(id).addEventListener("click", () => this.press(mode));
  }

  /** Whether a headset draws instead of the page. */
  get isInUse(): boolean {
    return this.session !== null;
  }

  /** Shows the buttons of the modes that a headset supports. */
  private async showButtons(): Promise<void> {
    for (const { mode, id } of MODES) {
      const isSupported = await navigator.xr?.isSessionSupported(mode).catch(() => false);
      element(id).hidden = isSupported !== true;
      // Loaded before the click, so that nothing is awaited after it.
      if (!isSupported) continue;
      for (const setting of document.querySelectorAll<HTMLElement>(".of-headset")) setting.hidden = false;
      this.load().catch(() => undefined);
    }
  }

  private load(): Promise<Headset> {
    this.headset ??= this.import().catch((error: unknown) => {
      this.headset = null; // The next press tries again.
      throw error;
    });
    return this.headset;
  }

  private async import(): Promise<Headset> {
    shareThree();
    const script = await import("./headset");
    return new script.Headset(this.parts);
  }

  private press(mode: HeadsetMode): void {
    if (this.session) {
      void this.session.end();
      return;
    }
    // Browsers grant a session only in the click itself, so that nothing may be awaited before.
    const request = navigator.xr!.requestSession(mode, {
      requiredFeatures: ["local-floor"],
      optionalFeatures: element("headset-hands", HTMLSelectElement).value === "hands" ? ["hand-tracking"] : [],
    });
    this.run(request, mode).catch((error: unknown) => showToast(`The headset cannot be entered: ${reasonOf(error)}`));
  }

  private async run(request: Promise<XRSession>, mode: HeadsetMode): Promise<void> {
    const session = await request;
    this.session = session;
    const ended = new Promise<void>((done) => session.addEventListener("end", () => done()));
    try {
      const headset = await this.load();
      await headset.run(session, mode);
    } catch (error) {
      await session.end().catch(() => undefined);
      throw error;
    } finally {
      await ended;
      this.session = null;
    }
  }
}

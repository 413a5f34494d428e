// Who has control, and the buttons to take it, give it back and hand it over.

import { announce } from "../panels/announcer";
import { element } from "../panels/element";
import { make, setText } from "../panels/html";
import { disable } from "../panels/title";
import { showToast } from "../panels/toast";
import type { Commander } from "./commander";
import type { SteerRequest } from "./messages";
import { leaseText, robotName } from "./texts";

export class LeasePanel {
  private readonly take = element("steer-take", HTMLButtonElement);
  private readonly release = element("steer-release", HTMLButtonElement);
  private readonly offer = element("steer-offer", HTMLButtonElement);
  private readonly to = element("steer-to", HTMLSelectElement);
  private shownClients = "";
  private holder: number | null = null;
  private isOffered = false;

  constructor(
    private readonly commander: Commander,
    send: (request: SteerRequest) => void,
  ) {
    this.take.addEventListener("click", () => send({ type: "lease", action: "take" }));
    this.release.addEventListener("click", () => send({ type: "lease", action: "release" }));
    this.offer.addEventListener("click", () => send({ type: "lease", action: "offer", to: Number(this.to.value) }));
  }

  show(): void {
    const { arm, state, isOpen, hasControl } = this.commander;
    const isKnown = isOpen && arm !== null && state !== null;
    setText(element("steer-lease"), isKnown ? leaseText(state, arm.client, this.robot) : "No link to the robot");
    element("toggle-steer").dataset.control = hasControl ? "own" : typeof state?.holder === "number" ? "other" : "nobody";
    this.take.hidden = hasControl;
    disable(this.take, this.reasonAgainstTaking());
    this.release.hidden = !hasControl;
    this.listClients();
    const others = this.to.options.length > 0;
    for (const shown of document.querySelectorAll<HTMLElement>(".steer-offer")) shown.hidden = !hasControl || !others;
    element("steer-controls").hidden = !hasControl;
    this.announceHolder();
    this.announceOffer();
  }

  private get robot(): string {
    const { arm } = this.commander;
    return robotName(arm === null || arm.joints.length > 0, arm?.base != null);
  }

  /** Why nobody can take control here now; empty if it is possible. */
  private reasonAgainstTaking(): string {
    const { arm, state, isOpen } = this.commander;
    if (!arm || !state || !isOpen) return "There is no link to the robot";
    if (!arm.may_steer) return "Only operators can steer. You are connected as viewer: ask for an operator's link";
    const isFree = state.holder === null || state.offered_to === arm.client;
    return isFree ? "" : `Operator ${state.holder} has control: ask for it`;
  }

  private listClients(): void {
    const { arm, state } = this.commander;
    const others = (state?.clients ?? []).filter(({ id, role }) => role === "operator" && id !== arm?.client);
    const shown = others.map(({ id }) => id).join();
    if (shown === this.shownClients) return;
    this.shownClients = shown;
    const chosen = this.to.value;
    this.to.replaceChildren(
      ...others.map(({ id }) => make("option", { value: String(id), textContent: `operator ${id}` })),
    );
    if (others.some(({ id }) => String(id) === chosen)) this.to.value = chosen;
  }

  private announceOffer(): void {
    const { arm, state } = this.commander;
    const isOffered = state !== null && state.holder !== null && state.offered_to === arm?.client;
    if (isOffered && !this.isOffered) {
      const text = `Operator ${state.holder} offers you control of the ${this.robot}: press Take control under Steer`;
      announce(text);
      showToast(text);
    }
    this.isOffered = isOffered;
  }

  private announceHolder(): void {
    const { arm, state } = this.commander;
    const holder = state?.holder ?? null;
    if (holder === this.holder) return;
    const had = this.holder === arm?.client;
    this.holder = holder;
    if (holder === arm?.client) announce(`You have control of the ${this.robot}. Space stops it`);
    else if (had) announce(`You no longer have control of the ${this.robot}`);
  }
}

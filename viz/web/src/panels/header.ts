// The operator's header. It shows the robot, its state, the advice, and the connected clients.

import type { Status } from "../connection/protocol";
import { closesWithEscape } from "../keys";
import { element } from "./element";
import { closePanel } from "./focus";
import { child, setText } from "./html";
import { colorOf, detailsOf, iconOf, letterOf, nameOf } from "./identity";
import { bytesText, countText } from "./quantities";
import { setTitle } from "./title";

/** States in which data are lost, or nothing is learned, until the operator acts. */
const HELD_STATES = ["paused"];

export class Header {
  /** Number of this client; null before the server's hello. */
  client: number | null = null;
  private icon = "";

  constructor() {
    const clients = element("clients", HTMLDetailsElement);
    const close = (): void => closePanel(clients, element("n-clients"), () => (clients.open = false));
    closesWithEscape("panel", () => clients.open, close, clients);
  }

  /** Without a connection, nobody knows who is connected, and the advice cannot be followed. */
  disconnected(): void {
    element("clients").hidden = true;
    text("advice", "");
  }

  show(status: Status): void {
    this.showIdentity(status);
    this.showState(status);
    this.showCounts(status);
    this.showClients(status);
  }

  private showIdentity({ identity, state }: Status): void {
    const name = nameOf(identity);
    const badge = element("badge");
    badge.hidden = name === "";
    document.title = [name, state, "fieldrig"].filter((part) => part !== "").join(" · ");
    text("rig", name);
    text("run-name", detailsOf(identity));
    if (name === this.icon || name === "") return;
    this.icon = name;
    badge.textContent = letterOf(name);
    badge.style.background = colorOf(name);
    const link = document.querySelector<HTMLLinkElement>("link[rel=icon]");
    if (link) link.href = iconOf(name);
  }

  private showState({ state, advice, paused_by: pausedBy }: Status): void {
    const chip = element("state");
    text("state", state);
    chip.dataset.kind = HELD_STATES.includes(state) ? "held" : "active";
    const line = element("advice");
    const sentence = advice?.text ?? "";
    const byThis = pausedBy !== undefined && pausedBy === this.client;
    text("advice", byThis ? sentence.replace(`by client ${pausedBy}`, "by you") : sentence);
    setTitle(line, line.textContent);
    line.dataset.kind = advice?.is_warning === true ? "warning" : "info";
  }

  private showCounts({ images, store }: Status): void {
    const dropped = images?.dropped ?? 0;
    const chips = [
      { id: "dropped", text: dropped > 0 ? `${countText(dropped)} dropped` : "" },
      { id: "store", text: store?.is_full ? "store full" : "" },
    ];
    for (const chip of chips) text(chip.id, chip.text);
    if (store) setTitle(element("store"), `${storeText(store)} of keyframes; new ones replace similar ones`);
  }

  private showClients({ clients }: Status): void {
    const panel = element("clients");
    panel.hidden = clients === undefined || clients.length === 0;
    if (!clients) return;
    text("n-clients", clients.length === 1 ? "1 client" : `${clients.length} clients`);
    const names = clients.map(({ id, role }) => `client ${id}, ${role}${id === this.client ? " (you)" : ""}`);
    if (element("client-list").textContent === names.join("")) return; // Keeps a selection of the text.
    element("client-list").replaceChildren(...names.map((name) => child("li", name)));
  }
}

/** Number and memory of the keyframes in the store. */
export function storeText({ keyframes, max_keyframes: max, bytes }: NonNullable<Status["store"]>): string {
  return `${countText(keyframes)} of ${countText(max)}, ${bytesText(bytes)}`;
}

function text(id: string, value: string): void {
  setText(element(id), value);
}

// Access to a shared server: the token, and the role that the server assigns.

import { element } from "../panels/element";
import { disable } from "../panels/title";
import type { Role } from "./protocol";
import { onlyView } from "../view/remembered";

const VIEWER_REASON = "Only operators can do this; you are connected as viewer";

/**
 * Moves the token from the address to a cookie, with which the browser authenticates all requests to this server.
 * Returns whether there was a token.
 */
export function keepToken(): boolean {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  if (token === null || location.protocol !== "https:") return false;
  const name = `__Host-fieldrig-${location.port || "443"}`;
  // biome-ignore lint/suspicious/noDocumentCookie: not all browsers that can show this page have the Cookie Store API.
  document.cookie = `${name}=${encodeURIComponent(token)}; Path=/; Secure; SameSite=Strict`;
  history.replaceState(null, "", location.pathname + location.search + onlyView(location.hash));
  return true;
}

/** Why the server refuses this page, in one sentence. Empty if the server accepts the page or does not answer. */
export async function refusalReason(): Promise<string> {
  try {
    const response = await fetch("status", { cache: "no-store" });
    return response.status === 401 || response.status === 403 ? await response.text() : "";
  } catch {
    return "";
  }
}

/** Shows the role, and disables the controls with `data-operator` for viewers. Older servers have no roles. */
export function showRole(role: Role | undefined): void {
  const isViewer = role === "viewer";
  element("role").textContent = isViewer ? "viewer" : "";
  disableAll("[data-server]", "");
  disableAll("[data-operator]", isViewer ? VIEWER_REASON : "");
}

/** Disables all controls that need a server, until a server sends its hello. */
export function disableServerControls(reason: string): void {
  disableAll("[data-server], [data-operator]", reason);
}

function disableAll(selector: string, reason: string): void {
  for (const control of document.querySelectorAll<HTMLButtonElement>(selector)) disable(control, reason);
}

// Announces changes of the state to screen readers.

import { element } from "./element";

/** Announces the states of the run and of the connection whenever they change. The banner announces losses itself. */
export function announceStates(): void {
  const [run, connection] = [element("state"), element("connection")];
  let announced = "";
  new MutationObserver(() => {
    const text = run.textContent;
    if (text !== "" && text !== announced) announce(`Run: ${text}`);
    announced = text;
  }).observe(run, { childList: true, characterData: true, subtree: true });
  let before = connection.dataset.state;
  new MutationObserver(() => {
    const { state } = connection.dataset;
    if (state === "open" && before !== "connecting" && before !== "open") announce("Connected again");
    before = state;
  }).observe(connection, { attributeFilter: ["data-state"] });
}

/** Says a text when the user is idle. */
export function announce(text: string): void {
  element("announcer").textContent = text;
}

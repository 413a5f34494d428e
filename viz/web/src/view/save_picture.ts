// Saves what the view shows as a PNG file.

import { download } from "../panels/download";
import { element } from "../panels/element";
import type { OrbitView } from "./orbit_view";

/** Connects the button that saves the view. */
export function setUpSavePicture(view: OrbitView): void {
  const canvas = element("canvas", HTMLCanvasElement);
  element("save-picture").addEventListener("click", () => {
    const note = element("path-note");
    note.textContent = "";
    // The browser discards the drawing after the frame, so that it has to be drawn now.
    view.changed();
    view.draw();
    canvas.toBlob((file) => {
      if (file) download(file, `fieldrig-${timeName(new Date())}.png`);
      else note.textContent = "Cannot save the picture: the browser has not enough memory";
    }, "image/png");
  });
}

/** A name from the local time, such as 2026-11-29-110934. */
function timeName(now: Date): string {
  const digits = (value: number): string => String(value).padStart(2, "0");
  const date = [now.getFullYear(), digits(now.getMonth() + 1), digits(now.getDate())].join("-");
  return `${date}-${[now.getHours(), now.getMinutes(), now.getSeconds()].map(digits).join("")}`;
}

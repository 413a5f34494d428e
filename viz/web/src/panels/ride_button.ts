// The button below a camera image that attaches the view to the camera.

import { make } from "./html";

/** A button for this camera. Clicks on it are not clicks on the image. */
export function rideButton(camera: string, isRidden: boolean, ride: () => void): HTMLButtonElement {
  const button = make("button", {
    className: "ride",
    textContent: "◎",
    title: "View from this camera, and move with it",
    ariaLabel: `View from the camera ${camera}, and move with it`,
    ariaPressed: String(isRidden),
  });
  button.addEventListener("click", (event) => {
    event.stopPropagation();
    ride();
  });
  return button;
}

/** Shows at an image whether the view rides on its camera. */
export function markRidden(figure: HTMLElement, isRidden: boolean): void {
  const button = figure.querySelector("button.ride");
  if (button) button.ariaPressed = String(isRidden);
}

// The part of the view that nothing on top of it covers.

import { element } from "../panels/element";
import { PHONE } from "../panels/windows";

/** The lowest clear row of the view, pixels of the canvas. On phones, messages and images fill the width below it. */
export function clearBottomPx(canvas: HTMLElement): number {
  const isPhone = matchMedia(PHONE).matches;
  return isPhone ? Math.min(element("view-bottom").offsetTop, canvas.clientHeight) : canvas.clientHeight;
}

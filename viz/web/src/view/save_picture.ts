// Saves what the view shows as a PNG file.

import type { Identity } from "../connection/protocol";
import { isPressed } from "../keys";
import { download } from "../panels/download";
import { element } from "../panels/element";
import { detailsOf, nameOf } from "../panels/identity";
import type { PictureInfo } from "../panels/picture_info";
import { showToast } from "../panels/toast";
import type { OrbitView } from "./orbit_view";
import { drawCaption, pictureName, timeText } from "./picture_caption";

/** If the full picture has not arrived within this time, what is there is saved. */
const MAX_WAIT_MILLIS = 5000;
const CHECK_MILLIS = 50;

/** Connects the button that saves the view. */
export function setUpSavePicture(view: OrbitView, info: PictureInfo, identity: () => Identity | undefined): void {
  const canvas = element("canvas", HTMLCanvasElement);
  const isReady = (): boolean => info.isComplete || !isPressed("toggle-model");
  let isSaving = false;
  element("save-picture").addEventListener("click", () => {
    if (isSaving) return;
    isSaving = true;
    if (!isReady()) showToast("Saving when the full picture is there");
    const begin = performance.now();
    const saveWhenReady = (): void => {
      if (!isReady() && performance.now() - begin < MAX_WAIT_MILLIS) {
        setTimeout(saveWhenReady, CHECK_MILLIS);
        return;
      }
      isSaving = false;
      save();
    };
    saveWhenReady();
  });

  const save = (): void => {
    const time = new Date();
    const name = pictureName(identity(), info.method, time);
    const picture = document.createElement("canvas");
    picture.width = canvas.width;
    picture.height = canvas.height;
    const context = picture.getContext("2d");
    // The browser discards the drawing after the frame, so that it has to be drawn now.
    view.changed();
    view.draw();
    context?.drawImage(canvas, 0, 0);
    const model = isPressed("toggle-model") ? info.summary : "without the model";
    const texts = [nameOf(identity()), detailsOf(identity()), model, timeText(time)];
    const text = texts.filter((part) => part !== "").join(" · ");
    if (context) drawCaption(context, canvas.width / canvas.clientWidth, text, view.observations.legend);
    picture.toBlob((file) => {
      if (file) download(file, name);
      showToast(file ? `Saved ${name}` : "Cannot save the picture: the browser has not enough memory");
    }, "image/png");
  };
}

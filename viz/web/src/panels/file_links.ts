// Links to the files that the server offers.

import type { FileLink } from "../connection/protocol";

/** Links to files. If there is a reason why the files cannot be opened, the links have no addresses. */
export function fileLinks(files: readonly FileLink[], unavailable: string): HTMLAnchorElement[] {
  return files.map((file) => {
    const link = document.createElement("a");
    link.textContent = file.label;
    if (unavailable) {
      link.setAttribute("aria-disabled", "true");
      link.title = unavailable;
      return link;
    }
    link.href = file.path;
    if (file.is_page) {
      link.target = "_blank";
      link.rel = "noopener";
      link.title = "Open the report in another tab";
    } else {
      link.download = "";
      link.title = "Download the saved model, without the space that saved edits have erased";
    }
    return link;
  });
}

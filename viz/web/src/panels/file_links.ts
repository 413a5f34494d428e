// Links to the files that the server offers.

import type { FileLink } from "../connection/protocol";

/**
 * Links to files. When the program has ended, the links have no addresses, and say where the files
 * are: in `folder`, which is null before.
 */
export function fileLinks(files: readonly FileLink[], folder: string | null): HTMLAnchorElement[] {
  return files.map((file) => {
    const link = document.createElement("a");
    link.textContent = file.label;
    if (folder !== null) {
      link.setAttribute("aria-disabled", "true");
      link.title = `The program has ended. Its files are in ${folder}`;
      return link;
    }
    link.href = file.path;
    if (file.is_page) {
      link.target = "_blank";
      link.rel = "noopener";
      link.title = "Open the report in another tab";
    } else {
      link.download = "";
      const isModel = !file.path.endsWith(".json");
      link.title = isModel ? "Download the saved model, without the space that saved edits have erased" : `Download: ${file.label}`;
    }
    return link;
  });
}

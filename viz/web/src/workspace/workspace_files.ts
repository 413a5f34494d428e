// Saves and opens workspace files: with buttons, keys, by dropping a file, and at the start if the server has one. The script that
// reads and writes them is loaded when it is needed first.

import { action } from "../keys";
import type { Identity } from "../connection/protocol";
import { element } from "../panels/element";
import type { LiveImages } from "../panels/live_images";
import { reasonOf } from "../panels/sentence";
import type { OrbitView } from "../view/orbit_view";
import type { ViewMemory } from "../view/view_memory";

/** What a workspace consists of. */
export interface WorkspaceParts {
  memory: ViewMemory;
  view: OrbitView;
  images: LiveImages;
  identity: () => Identity | undefined;
  /** Shows a message. */
  say: (text: string) => void;
}

/** Path of the workspace with which pages of this server start. */
const OF_SERVER = "workspace";

export class WorkspaceFiles {
  private hasStarted = false;

  constructor(private readonly parts: WorkspaceParts) {
    const input = element("workspace-file", HTMLInputElement);
    action("save-workspace", () => void this.use((script) => script.save(parts)));
    action("open-workspace", () => input.click());
    input.addEventListener("change", () => {
      const file = input.files?.[0];
      if (file) void this.open(file);
      input.value = ""; // The same file can be opened again.
    });
    window.addEventListener("dragover", (event) => {
      if (event.dataTransfer?.types.includes("Files")) event.preventDefault();
    });
    window.addEventListener("drop", (event) => {
      const file = event.dataTransfer?.files[0];
      if (!file) return;
      event.preventDefault(); // Otherwise, the browser leaves the page and shows the file.
      void this.open(file);
    });
  }

  /** Shows the workspace of the server, unless the user or the address of the page has chosen a view. */
  serverHasOne(hasOne: boolean): void {
    if (!hasOne || this.hasStarted) return;
    this.hasStarted = true;
    if (!this.parts.memory.isUntouched) return;
    void this.use(async (script) => {
      const response = await fetch(OF_SERVER, { cache: "no-store" });
      const text = await response.text();
      if (!response.ok) throw new Error(text);
      if (this.parts.memory.isUntouched) script.show(this.parts, text, "The workspace of this server");
    });
  }

  private open(file: File): Promise<void> {
    return this.use((script) => script.open(this.parts, file));
  }

  private async use(act: (script: typeof import("./workspace_page")) => Promise<void> | void): Promise<void> {
    try {
      await act(await import("./workspace_page"));
    } catch (error) {
      this.parts.say(`Workspaces cannot be used now: ${reasonOf(error)}`);
    }
  }
}

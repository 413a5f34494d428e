// Turns what the page shows into a workspace file, and shows a workspace. This script is loaded when it is needed first.

import { download } from "../panels/download";
import { element } from "../panels/element";
import { nameOf } from "../panels/identity";
import { PHONE } from "../panels/windows";
import type { ShownState } from "../view/view_memory";
import { type DrawingMode, MAX_BYTES, type Workspace, workspaceIn, workspaceText } from "./workspace";
import type { WorkspaceParts } from "./workspace_files";

/** Switches that are other parts of a workspace than layers. */
const CROP = "crop";
const LOCAL = "local";

/** Lets the browser save what is shown. */
export function save(parts: WorkspaceParts): void {
  const name = fileName(nameOf(parts.identity()));
  download(new Blob([workspaceText(workspaceNow(parts))], { type: "application/json" }), name);
  parts.say(`Saved ${name}`);
}

/** Opens a file that the user has chosen. */
export async function open(parts: WorkspaceParts, file: File): Promise<void> {
  // Longer files are refused. Their beginning is sufficient for that.
  show(parts, await file.slice(0, 4 * MAX_BYTES).text(), file.name);
}

/** Shows a workspace, or the reason why the text of a file is none. */
export function show(parts: WorkspaceParts, text: string, name: string): void {
  const workspace = workspaceIn(text);
  if (typeof workspace === "string") {
    parts.say(`${name} cannot be opened: ${workspace}`);
    return;
  }
  showPanels(parts, workspace);
  parts.memory.change(stateOf(workspace));
  if (workspace.crop && !workspace.crop.box) parts.view.crop.reset();
  parts.say(`Opened ${name}`);
}

function fileName(identity: string): string {
  const name = identity === "" ? "fieldrig" : identity;
  return `${name.replace(/[^\p{L}\p{N}._-]+/gu, "-")}.workspace.json`;
}

function workspaceNow({ memory, images, view }: WorkspaceParts): Workspace {
  const { view: camera, crop, method, path, switches } = memory.state;
  const { [CROP]: isCropped = false, [LOCAL]: isLocal = false, ...layers } = switches;
  const isFollowing = view.mode === "overview" && crop === null;
  return {
    ...(camera && {
      camera: {
        mode: camera.mode,
        position_m: camera.position,
        target_m: camera.target,
        up: camera.mode === "ride" ? camera.up : [0, 0, 1],
        ...(camera.fovDegrees !== undefined && { fov_degrees: camera.fovDegrees }),
        ...(camera.attachedTo !== undefined && { attached_to: camera.attachedTo }),
      },
    }),
    crop: {
      is_on: isCropped,
      // Other programs do not know which box fits the scene.
      ...((isCropped || crop !== null) && !isFollowing && { box: boxOf(view.crop.pose) }),
    },
    layers,
    panels: { side: !element("run").hidden, ...openPanel(), docked_cameras: images.dockedCameras },
    ...(method !== null && { model: method }),
    mode: isLocal ? "direct" : "pictures",
    ...(path.length > 0 && {
      path: path.map((at) => ({ position_m: at.position, target_m: at.target, fov_degrees: at.fovDegrees })),
    }),
  };
}

function boxOf({ center, size, yaw }: WorkspaceParts["view"]["crop"]["pose"]): NonNullable<NonNullable<Workspace["crop"]>["box"]> {
  return { center_m: center.toArray(), size_m: size.toArray(), yaw_rad: yaw };
}

function stateOf({ camera, crop, layers, model, mode, path }: Workspace): Partial<ShownState> {
  return {
    ...(camera && {
      view: {
        mode: camera.mode,
        position: camera.position_m,
        target: camera.target_m,
        up: camera.up,
        ...(camera.fov_degrees !== undefined && { fovDegrees: camera.fov_degrees }),
        ...(camera.attached_to !== undefined && { attachedTo: camera.attached_to }),
      },
    }),
    switches: {
      ...layers,
      ...(crop && { [CROP]: crop.is_on }),
      ...(mode && { [LOCAL]: isDirect(mode) }),
    },
    ...(crop?.box && { crop: { center: crop.box.center_m, size: crop.box.size_m, yaw: crop.box.yaw_rad } }),
    ...(model !== undefined && { method: model }),
    ...(path && { path: path.map((at) => ({ position: at.position_m, target: at.target_m, fovDegrees: at.fov_degrees })) }),
  };
}

function isDirect(mode: DrawingMode): boolean {
  return mode === "direct";
}

/** The open panel below the toolbar, if there is one. The panel with the buttons for files does not count. */
function openPanel(): { open?: string } {
  const opener = openers().find((button) => isOpen(button));
  const panel = opener?.getAttribute("aria-controls");
  return panel && panel !== "views" ? { open: panel } : {};
}

function showPanels({ images }: WorkspaceParts, { panels }: Workspace): void {
  if (!panels) return;
  if (panels.docked_cameras) images.dockedCameras = panels.docked_cameras;
  const side = element("toggle-run");
  // On phones, the panel would cover the view.
  if (panels.side !== undefined && !matchMedia(PHONE).matches && panels.side !== isOpen(side)) side.click();
  for (const opener of openers()) {
    const isWanted = opener.getAttribute("aria-controls") === panels.open;
    if (isOpen(opener) !== isWanted && !(isWanted && opener.hidden)) opener.click();
  }
}

/** The buttons of the panels below the toolbar. */
function openers(): HTMLElement[] {
  const all = document.querySelectorAll<HTMLElement>("#toolbar [aria-controls]:not(#toggle-run, #show-more)");
  return [...all];
}

function isOpen(opener: HTMLElement): boolean {
  return opener.getAttribute("aria-expanded") === "true";
}

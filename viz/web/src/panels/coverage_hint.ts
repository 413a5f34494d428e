// Shows where to look next: an arrow in the scene, and the direction relative to the live camera.

import { Vector3 } from "three";
import type { LiveImageHeader, ObservationsHeader, Scene } from "../connection/protocol";
import { CoverageMarker } from "../layers/coverage_marker";
import type { ObservationsTopic } from "../topics/observations";
import type { OrbitView } from "../view/orbit_view";
import { directionText, directionTo, reasonText, type WorstPlace, worstPlace } from "./coverage";
import { element } from "./element";
import { make, setText } from "./html";

/** Period of updating the direction from the live camera to the place, because the camera moves. */
const UPDATE_MILLIS = 250;

/** What the hint needs from the rest of the page. */
export interface CoverageSources {
  view: OrbitView;
  topic: ObservationsTopic;
  /** The newest live image with a pose. */
  live(): LiveImageHeader | null;
}

export class CoverageHint {
  private readonly marker = new CoverageMarker();
  private readonly root = make("div", { id: "coverage", className: "coverage", hidden: true });
  private readonly text = make("span", { id: "coverage-text" });
  private readonly look = make("button", { id: "coverage-look", textContent: "Look", title: "Turn the view toward this place" });
  private scene: Scene | null = null;
  private map: { header: ObservationsHeader; codes: Uint8Array } | null = null;
  private place: WorstPlace | null = null;
  private isEnabled = false;

  constructor(private readonly sources: CoverageSources) {
    const { view } = sources;
    view.overlays.root.add(this.marker.root);
    view.observations.onMap = (header, codes) => {
      this.map = { header, codes };
      this.update();
    };
    this.look.addEventListener("click", () => {
      if (this.place) view.turnTo(new Vector3(...this.place.pointM));
    });
    this.root.append(this.text, this.look);
    element("view").querySelector(".bottom")?.prepend(this.root);
    window.setInterval(() => {
      if (this.isEnabled) this.showText();
    }, UPDATE_MILLIS);
  }

  /** Whether the hint is shown. */
  set enabled(isEnabled: boolean) {
    this.isEnabled = isEnabled;
    this.root.hidden = !isEnabled;
    this.sources.topic.searched = isEnabled;
    this.update();
  }

  setScene(scene: Scene): void {
    this.scene = scene;
    this.update();
  }

  /** Forgets the map, because a new connection sends another one. */
  restart(): void {
    this.map = null;
    this.update();
  }

  private update(): void {
    const { map, scene } = this;
    this.place = this.isEnabled && map && scene ? worstPlace(map, scene) : null;
    this.marker.show(this.place?.pointM ?? null, scene?.radius_m ?? 1);
    this.sources.view.changed();
    if (this.isEnabled) this.showText();
  }

  private showText(): void {
    setText(this.text, this.hint());
    this.look.hidden = this.place === null;
  }

  private hint(): string {
    if (!this.map) return "Look here next: waiting for the map of observations";
    if (!this.place) return "Look here next: everything within reach was seen well";
    const reason = reasonText(this.place, this.map.header.newest_millis !== null);
    const live = this.sources.live();
    if (!live?.world_from_camera) return `Look here next: ${reason}`;
    const direction = directionText(directionTo(this.place.pointM, live.world_from_camera));
    return `Look here next, from ${live.camera}: ${direction} (${reason})`;
  }
}

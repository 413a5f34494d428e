// Shows where to look next: an arrow in the scene, and the direction relative to the live camera.

import { Vector3 } from "three";
import type { LiveImageHeader, ObservationsHeader, PosedCamera, Scene } from "../connection/protocol";
import { CoverageMarker } from "../layers/coverage_marker";
import type { ObservationsTopic } from "../topics/observations";
import type { OrbitView } from "../view/orbit_view";
import type { WorstPlace } from "./coverage";
import { element } from "./element";
import { make, setText } from "./html";

/** Period of updating the direction from the live camera to the place, because the camera moves. */
const UPDATE_MILLIS = 250;

/** What the hint needs from the rest of the page. */
export interface CoverageSources {
  view: OrbitView;
  topic: ObservationsTopic;
  /** The newest live images with poses, one of each camera. */
  live(): (LiveImageHeader & PosedCamera)[];
  keyframes(): readonly PosedCamera[];
}

export class CoverageHint {
  private readonly marker = new CoverageMarker();
  private readonly root = make("div", { id: "coverage", className: "coverage", hidden: true });
  private readonly text = make("span", { id: "coverage-text" });
  private readonly look = make("button", { id: "coverage-look", textContent: "Look", title: "Look at this place, from where a camera was close to it" });
  /** The script that searches; null until it is loaded. */
  private search: typeof import("./coverage") | null = null;
  private scene: Scene | null = null;
  private map: { header: ObservationsHeader; codes: Uint8Array } | null = null;
  private place: WorstPlace | null = null;
  /** Number of the place among those that were shown. */
  private nPlaces = 0;
  /** The camera whose direction to the place is shown. */
  private camera: string | null = null;
  private isEnabled = false;
  /** Whether the devices send nothing more, so that no camera can be turned toward the place. */
  hasInputEnded = false;

  constructor(private readonly sources: CoverageSources) {
    const { view } = sources;
    view.overlays.root.add(this.marker.root);
    view.observations.onMap = (header, codes) => {
      this.map = { header, codes };
      this.update();
    };
    this.look.addEventListener("click", () => {
      if (!this.place || !this.search) return;
      const { pointM } = this.place;
      const eye = this.search.eyeFor([...sources.keyframes(), ...sources.live()], pointM);
      view.lookAt(new Vector3(...pointM), eye && new Vector3(...eye));
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
    if (isEnabled && !this.search) void this.load();
  }

  private async load(): Promise<void> {
    try {
      this.search = await import("./coverage");
    } catch {
      return; // There is no connection, and so no map. The next attempt loads it.
    }
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
    const { map, scene, search } = this;
    const before = this.place;
    this.place = this.isEnabled && map && scene && search ? search.worstPlace(map, scene, before) : null;
    if (this.place && this.place.centerM !== before?.centerM) this.nPlaces += 1;
    this.marker.show(this.place?.pointM ?? null, scene?.radius_m ?? 1);
    this.sources.view.changed();
    if (this.isEnabled) this.showText();
  }

  private showText(): void {
    setText(this.text, this.hint());
    this.look.hidden = this.place === null;
  }

  private hint(): string {
    const { search } = this;
    // Saved models have no newest keyframe.
    const isLive = !this.hasInputEnded && this.map?.header.newest_millis !== null;
    const title = isLive ? "Look here next" : "Seen worst";
    if (!this.map || !search) return `${title}: waiting for the map of observations`;
    if (!this.place) return `${title}: everything within reach was seen well`;
    const { pointM } = this.place;
    const reason = search.reasonText(this.place, isLive);
    const place = `${title}: place ${this.nPlaces} at ${search.placeText(pointM)} (${reason})`;
    if (!isLive) return place;
    const camera = search.cameraToTurn(this.sources.live(), pointM, this.camera);
    this.camera = camera?.camera ?? null;
    if (!camera) return place;
    return `${place}; from ${camera.camera}: ${search.directionText(search.directionTo(pointM, camera.world_from_camera))}`;
  }
}

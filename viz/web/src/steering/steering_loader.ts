// Loads the script for steering once a server has an arm that can be steered, or the incidents of a steered run. The script
// uses the classes of three.js of the page.

import { action, toggle } from "../keys";
import { RobotLayer } from "../layers/robot_layer";
import { element } from "../panels/element";
import { reasonOf } from "../panels/sentence";
import { showToast } from "../panels/toast";
import type { FileLink } from "../connection/protocol";
import type { Incidents } from "../incidents/incidents";
import { shareThree } from "../three_of_the_page";
import type { OrbitView } from "../view/orbit_view";
import type { PageParts, Steering } from "./steering";

/** Name of the file with the incidents. */
const INCIDENTS = "/steering-incidents.json";

export class SteeringLoader {
  private steering: Steering | null = null;
  private incidents: Incidents | null = null;
  private incidentsPath: string | null = null;
  private isLoading = false;
  private isOffered = false;

  constructor(private readonly view: OrbitView) {}

  /** Whether the server has an arm that can be steered. */
  set offered(isOffered: boolean) {
    if (isOffered === this.isOffered) return;
    this.isOffered = isOffered;
    element("toggle-steer").hidden = !isOffered;
    if (this.steering) this.steering.offered = isOffered;
    else if (isOffered) void this.load();
  }

  /** Shows the incidents of a steered run, if they are among the files of the server. */
  showIncidents(files: readonly FileLink[]): void {
    const file = files.find(({ path }) => path.endsWith(INCIDENTS));
    element("toggle-incidents").hidden = !file;
    this.incidentsPath = file?.path ?? null;
    if (this.incidents && file) void this.incidents.load(file.path);
    else if (file) void this.load();
  }

  /** The steering; null before it is loaded. */
  get loaded(): Steering | null {
    return this.isOffered ? this.steering : null;
  }

  private async load(): Promise<void> {
    if (this.isLoading) return;
    this.isLoading = true;
    try {
      shareThree();
      const script = await import("./steering");
      const { view } = this;
      const newRobotLayer: PageParts["newRobotLayer"] = (changed, newLook) => new RobotLayer(view.occlusion, changed, newLook);
      if (this.isOffered) this.steering ??= new script.Steering({ view, newRobotLayer, action, toggle });
      if (this.steering) this.steering.offered = this.isOffered;
      if (this.incidentsPath !== null) {
        this.incidents ??= new script.Incidents({ view, newRobotLayer });
        void this.incidents.load(this.incidentsPath);
      }
    } catch (error) {
      this.isOffered = false; // The next status tries again.
      showToast(`Steering cannot be loaded: ${reasonOf(error)}`);
    }
    this.isLoading = false;
  }
}

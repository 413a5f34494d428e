// The path of a moving base.

import type { OrbitView } from "../view/orbit_view";
import type { BasePath } from "../connection/protocol";
import { on, type Topic } from "./topic";

const HZ = 1;

export function basePathTopic(view: OrbitView): Topic {
  return {
    name: "base_path",
    capability: "base_path",
    receivers: [
      on<BasePath>("base_path", (message) => {
        view.scans.setPath(message.points_m, message.line_starts);
        view.changed();
      }),
    ],
    subscriptions: (isHidden) => [{ rate_hz: isHidden ? 0 : HZ }],
    restart: () => view.scans.setPath([]),
  };
}

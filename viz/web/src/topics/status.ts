// The status of the run.

import type { Status } from "../connection/protocol";
import { on, type Topic } from "./topic";

const HZ = 2;
/** While the page is hidden, the title bar still needs it. */
const HIDDEN_HZ = 0.5;

export function statusTopic(show: (status: Status) => void): Topic {
  return {
    name: "status",
    receivers: [on<Status>("status", show)],
    subscriptions: (isHidden) => [{ rate_hz: isHidden ? HIDDEN_HZ : HZ }],
    restart() {},
  };
}

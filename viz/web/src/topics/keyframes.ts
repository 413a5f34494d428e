// The poses of the keyframes.

import { KeyframeList } from "../panels/keyframe_list";
import type { OrbitView } from "../view/orbit_view";
import type { KeyframeChanges, Keyframes } from "../connection/protocol";
import { on, type Topic } from "./topic";

const HZ = 2;

export class KeyframesTopic implements Topic {
  readonly name = "keyframes";
  readonly list = new KeyframeList();
  /** Called after changes of the list. */
  onChange: () => void = () => undefined;
  readonly receivers = [
    on<Keyframes>("keyframes", (message) => {
      this.view.overlays.setKeyframes(message.keyframes);
      this.view.changed();
    }),
    on<KeyframeChanges>("keyframe_changes", (message) => {
      this.list.apply(message);
      this.view.points.setKeyframes(this.list.keyframes);
      this.view.overlays.setKeyframes(this.list.keyframes);
      this.view.changed();
      this.onChange();
    }),
  ];

  constructor(private readonly view: OrbitView) {}

  subscriptions(isHidden: boolean): { rate_hz: number }[] {
    return [{ rate_hz: isHidden ? 0 : HZ }];
  }

  restart(): void {}
}

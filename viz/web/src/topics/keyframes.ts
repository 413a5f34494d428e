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
  readonly onChange: (() => void)[] = [];
  readonly receivers = [
    on<Keyframes>("keyframes", (message) => {
      this.view.overlays.setKeyframes(message.keyframes);
      this.view.changed();
    }),
    on<KeyframeChanges>("keyframe_changes", (message) => {
      this.list.apply(message);
      this.view.points.setKeyframes(this.list.keyframes);
      this.show();
      for (const changed of this.onChange) changed();
    }),
  ];
  private untilNanos: number | null = null;
  private isOn = false;
  private isInHistory = false;

  constructor(private readonly view: OrbitView) {}

  /** Whether the layer of keyframes is on. */
  set isLayerOn(isOn: boolean) {
    this.isOn = isOn;
    this.showFrustums();
  }

  /** Whether the user goes back in time, for which keyframes are drawn, too. */
  set isBrowsed(isBrowsed: boolean) {
    this.isInHistory = isBrowsed;
    this.showFrustums();
  }

  private showFrustums(): void {
    this.view.overlays.showsKeyframes = this.isOn || this.isInHistory;
    this.view.changed();
  }

  /** Draws only the keyframes up to this time on the clock of the rig; all of them if null. */
  showUntil(nanos: number | null): void {
    this.untilNanos = nanos;
    this.show();
  }

  private show(): void {
    const { untilNanos } = this;
    const all = this.list.keyframes;
    const shown = untilNanos === null ? all : all.filter((keyframe) => keyframe.stamp_nanos <= untilNanos);
    this.view.points.showOnly(untilNanos === null ? null : new Set(shown.map((keyframe) => keyframe.id)));
    this.view.overlays.setKeyframes(shown);
    this.view.changed();
  }

  subscriptions(isHidden: boolean): { rate_hz: number }[] {
    return [{ rate_hz: isHidden ? 0 : HZ }];
  }

  restart(): void {}
}

// The hands of the operator: controllers, or bare hands whose pinch is a trigger. Reads the poses once a frame, and collects
// the events between frames.

import { Matrix4, Vector3 } from "three";

export type Side = "left" | "right";

/** A hand in one frame, in the space of the headset. */
export interface Hand {
  side: Side;
  isBare: boolean;
  /** The ray with which the hand points. */
  ray: { from: Vector3; direction: Vector3 };
  /** Pose of what the hand holds. */
  grip: Matrix4;
  /** Outward direction of the palm. */
  palm: Vector3;
  isTrigger: boolean;
  isSqueeze: boolean;
  /** Right and forward, -1 to 1. */
  stick: [number, number];
}

interface Pressed {
  isTrigger: boolean;
  isSqueeze: boolean;
}

export class HandInput {
  private readonly pressed = new Map<XRInputSource, Pressed>();
  private hands = new Map<Side, Hand>();
  /** Sources whose position has been measured, and not guessed. */
  private readonly measured = new WeakSet<XRInputSource>();

  constructor(
    private readonly session: XRSession,
    private readonly pressBegins: (side: Side) => void,
  ) {
    const set = (key: keyof Pressed, isDown: boolean) => (event: XRInputSourceEvent): void => {
      const { inputSource } = event;
      const state = this.pressed.get(inputSource) ?? { isTrigger: false, isSqueeze: false };
      state[key] = isDown;
      this.pressed.set(inputSource, state);
      const side = sideOf(inputSource);
      if (key === "isTrigger" && isDown && side) this.pressBegins(side);
    };
    session.addEventListener("selectstart", set("isTrigger", true));
    session.addEventListener("selectend", set("isTrigger", false));
    session.addEventListener("squeezestart", set("isSqueeze", true));
    session.addEventListener("squeezeend", set("isSqueeze", false));
    session.addEventListener("inputsourceschange", ({ removed }) => {
      for (const source of removed) this.pressed.delete(source);
    });
  }

  /** The hand on this side; null while it is not tracked. */
  hand(side: Side): Hand | null {
    return this.hands.get(side) ?? null;
  }

  /** Reads all hands. */
  read(frame: XRFrame, space: XRReferenceSpace): void {
    this.hands = new Map();
    for (const source of this.session.inputSources) {
      const side = sideOf(source);
      const hand = side && this.handOf(side, source, frame, space);
      if (hand) this.hands.set(hand.side, hand);
    }
  }

  /** Forgets what is pressed, because the session does not report it while it is hidden. */
  release(): void {
    this.pressed.clear();
    this.hands.clear();
  }

  private handOf(side: Side, source: XRInputSource, frame: XRFrame, space: XRReferenceSpace): Hand | null {
    const rayPose = frame.getPose(source.targetRaySpace, space);
    const gripPose = source.gripSpace ? frame.getPose(source.gripSpace, space) : rayPose;
    if (!rayPose || !gripPose) return null;
    // A guessed position, as of a controller behind the back, counts as lost. Some devices only guess.
    if (!gripPose.emulatedPosition) this.measured.add(source);
    else if (this.measured.has(source)) return null;
    const ray = new Matrix4().fromArray(rayPose.transform.matrix);
    const grip = new Matrix4().fromArray(gripPose.transform.matrix);
    const { isTrigger, isSqueeze } = this.pressed.get(source) ?? { isTrigger: false, isSqueeze: false };
    // The axis x of the grip leaves the left palm and enters the right one (WebXR, section 6.2).
    const palm = new Vector3(side === "left" ? 1 : -1, 0, 0).transformDirection(grip);
    const axes = source.gamepad?.axes ?? [];
    return {
      side,
      isBare: source.hand !== undefined && source.hand !== null,
      ray: { from: new Vector3().setFromMatrixPosition(ray), direction: new Vector3(0, 0, -1).transformDirection(ray) },
      grip,
      palm,
      isTrigger,
      isSqueeze,
      // The first two axes are those of a touchpad.
      stick: [axes[2] ?? 0, -(axes[3] ?? 0)],
    };
  }
}

function sideOf({ handedness }: XRInputSource): Side | null {
  return handedness === "left" || handedness === "right" ? handedness : null;
}

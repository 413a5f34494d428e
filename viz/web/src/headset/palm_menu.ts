// The menu over the palm: a panel with texts and buttons, which the ray of the other hand presses.

import * as THREE from "three";
import type { Hand, Side } from "./hand_input";
import { buttonAt, cut, FONT_M, layOut, type MenuButton, type MenuContent, type MenuLayout, type Rect } from "./menu_layout";

/** Pixels of the texture per meter of the panel: 0.35 mm, finer than the pixels of a headset at arm's length. */
const PX_PER_M = 2800;
/** Position over the palm, and how far the palm may be turned away from the head, as a cosine. */
const OVER_PALM_M = 0.06;
const ABOVE_HAND_M = 0.12;
const SHOW_AT = 0.45;
const HIDE_AT = 0.25;
const FONT = "system-ui, sans-serif";

const COLORS = { ground: "#11161e", text: "#e6edf3", title: "#9aa4b2", button: "#222b38", on: "#2f6f60", hover: "#3d4b60", stop: "#c93c37", off: "#171c24" };

export interface MenuHit {
  button: MenuButton | null;
  distance: number;
}

export class PalmMenu {
  readonly root = new THREE.Group();
  /** Whether it stays where it is, and does not follow the palm. */
  isPinned = false;
  private readonly canvas = document.createElement("canvas");
  private readonly panel: THREE.Mesh<THREE.PlaneGeometry, THREE.MeshBasicMaterial>;
  private layout: MenuLayout = layOut({ lines: [], groups: [] });
  private drawn = "";
  private content: MenuContent | null = null;
  private hovered: string | null = null;

  constructor() {
    // Over everything else, because the stop button must not be behind splats.
    const material = new THREE.MeshBasicMaterial({ side: THREE.DoubleSide, depthTest: false, transparent: true });
    this.panel = new THREE.Mesh(new THREE.PlaneGeometry(1, 1), material);
    this.panel.renderOrder = 15;
    this.root.add(this.panel);
    this.root.visible = false;
    this.root.matrixAutoUpdate = false;
  }

  get isVisible(): boolean {
    return this.root.visible;
  }

  /** Places the menu over a palm that faces the head. `hand` is null while the hand is not tracked. */
  follow(hand: Hand | null, headInHeadset: THREE.Vector3): void {
    if (this.isPinned) return;
    if (!hand) {
      this.root.visible = false;
      return;
    }
    const at = new THREE.Vector3().setFromMatrixPosition(hand.grip);
    const toHead = headInHeadset.clone().sub(at).normalize();
    const facing = hand.palm.dot(toHead);
    this.root.visible = facing > (this.root.visible ? HIDE_AT : SHOW_AT);
    if (!this.root.visible) return;
    at.addScaledVector(toHead, OVER_PALM_M).y += ABOVE_HAND_M;
    this.root.matrix.lookAt(headInHeadset, at, new THREE.Vector3(0, 1, 0)).setPosition(at);
    this.root.matrixWorldNeedsUpdate = true;
  }

  /** Marks another button without new content. */
  repaintHover(): void {
    if (this.content) this.show(this.content);
  }

  /** Shows what has changed. */
  show(content: MenuContent): void {
    this.content = content;
    const key = JSON.stringify([content, this.hovered]);
    if (key === this.drawn || !this.root.visible) return;
    this.drawn = key;
    this.layout = layOut(content);
    this.paint();
  }

  /** The button under a ray of the headset's space; null if the ray misses the menu. */
  hit({ from, direction }: Hand["ray"]): MenuHit | null {
    if (!this.root.visible) return null;
    const menuFromHeadset = this.root.matrix.clone().invert();
    const start = from.clone().applyMatrix4(menuFromHeadset);
    const end = from.clone().add(direction).applyMatrix4(menuFromHeadset);
    const along = end.sub(start);
    const distance = -start.z / along.z;
    if (!(distance > 0)) return null;
    const x = start.x + distance * along.x + 0.5 * this.layout.width;
    const y = 0.5 * this.layout.height - (start.y + distance * along.y);
    if (x < 0 || y < 0 || x > this.layout.width || y > this.layout.height) return null;
    return { button: buttonAt(this.layout, x, y), distance };
  }

  /** Marks the button that a press would hit. */
  set hover(id: string | null) {
    this.hovered = id;
  }

  /** The centers of the buttons in the headset's space, for tests. */
  get places(): { id: string; label: string; isOn: boolean | undefined; at: number[] }[] {
    const { width, height } = this.layout;
    return this.layout.buttons.map(({ button, rect }) => ({
      id: button.id,
      label: button.label,
      isOn: button.isOn,
      at: new THREE.Vector3(rect.x + 0.5 * rect.width - 0.5 * width, 0.5 * height - rect.y - 0.5 * rect.height, 0)
        .applyMatrix4(this.root.matrix)
        .toArray(),
    }));
  }

  get lines(): string[] {
    return this.layout.lines.map(({ text }) => text);
  }

  dispose(): void {
    this.panel.material.map?.dispose();
    this.panel.material.dispose();
    this.panel.geometry.dispose();
    this.root.removeFromParent();
  }

  private paint(): void {
    const { canvas, layout } = this;
    const px = (meters: number): number => meters * PX_PER_M;
    const sizePx = [Math.ceil(px(layout.width)), Math.ceil(px(layout.height))] as const;
    const isResized = canvas.width !== sizePx[0] || canvas.height !== sizePx[1];
    if (isResized) [canvas.width, canvas.height] = sizePx;
    const context = canvas.getContext("2d")!;
    context.fillStyle = COLORS.ground;
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.textBaseline = "alphabetic";
    const widthOf = (text: string): number => context.measureText(text).width / PX_PER_M;
    for (const { text, x, y, isTitle } of layout.lines) {
      context.font = `${isTitle ? 600 : 400} ${px(FONT_M)}px ${FONT}`;
      context.fillStyle = isTitle ? COLORS.title : COLORS.text;
      context.fillText(cut(text, layout.width - 2 * x, widthOf), px(x), px(y));
    }
    for (const { button, rect } of layout.buttons) this.paintButton(context, button, rect, widthOf);
    this.upload(isResized);
  }

  private paintButton(
    context: CanvasRenderingContext2D,
    { id, label, isOn, isDisabled, isStop }: MenuButton,
    { x, y, width, height }: Rect,
    widthOf: (text: string) => number,
  ): void {
    const px = (meters: number): number => meters * PX_PER_M;
    const rest = isStop ? COLORS.stop : isOn ? COLORS.on : COLORS.button;
    context.fillStyle = isDisabled ? COLORS.off : id === this.hovered ? COLORS.hover : rest;
    context.beginPath();
    context.roundRect(px(x), px(y), px(width), px(height), px(0.003));
    context.fill();
    if (isStop && id === this.hovered) {
      context.strokeStyle = COLORS.stop;
      context.lineWidth = px(0.0015);
      context.stroke();
    }
    context.font = `${isStop ? 700 : 500} ${px(FONT_M)}px ${FONT}`;
    context.fillStyle = isDisabled ? COLORS.title : COLORS.text;
    const text = cut(label, width - 0.006, widthOf);
    context.fillText(text, px(x + 0.5 * (width - widthOf(text))), px(y + 0.5 * height + 0.35 * FONT_M));
  }

  private upload(isResized: boolean): void {
    const { material } = this.panel;
    if (isResized || !material.map) {
      material.map?.dispose();
      material.map = new THREE.CanvasTexture(this.canvas);
      material.map.generateMipmaps = true;
      material.map.minFilter = THREE.LinearMipmapLinearFilter;
      material.needsUpdate = true;
    }
    material.map.needsUpdate = true;
    this.panel.scale.set(this.layout.width, this.layout.height, 1);
  }
}

/** The hand that holds the menu: the other one points at it. */
export function otherSide(side: Side): Side {
  return side === "left" ? "right" : "left";
}

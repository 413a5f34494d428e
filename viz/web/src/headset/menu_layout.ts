// The layout of the palm menu: where its buttons are, how large its letters are, and which button a ray hits. Lengths are in
// meters on the panel, from its top left corner, x right and y down. This file has no DOM.

/** Distance of a panel over the palm from the eyes, meters. */
export const ARM_LENGTH_M = 0.6;
/** Smallest x-height that is easy to read, degrees. */
export const MIN_X_HEIGHT_DEGREES = 0.4;
/** x-height of the fonts of browsers, relative to the font size. The lowest of the common ones is that of Liberation Sans. */
export const X_HEIGHT = 0.519;

/** Size of the font and of the parts of the menu, meters. */
export const FONT_M = 0.0085;
const COLUMNS = 3;
const BUTTON_M = { width: 0.082, height: 0.021 };
const GAP_M = 0.003;
const MARGIN_M = 0.006;
const LINE_M = 0.0115;
export const MENU_WIDTH_M = COLUMNS * BUTTON_M.width + (COLUMNS - 1) * GAP_M + 2 * MARGIN_M;

export interface MenuButton {
  id: string;
  label: string;
  /** Whether it is on; undefined for buttons that are no switches. */
  isOn?: boolean;
  isDisabled?: boolean;
  /** A stop button is drawn in red. */
  isStop?: boolean;
  /** How many columns it takes; 1 if undefined. */
  span?: number;
}

/** The menu as it should be: lines of text, then groups of buttons. */
export interface MenuContent {
  lines: readonly string[];
  groups: readonly { title: string; buttons: readonly MenuButton[] }[];
}

export interface Rect {
  x: number;
  y: number;
  width: number;
  height: number;
}

export interface MenuLayout {
  width: number;
  height: number;
  lines: { text: string; x: number; y: number; isTitle: boolean }[];
  buttons: { button: MenuButton; rect: Rect }[];
}

/** Angle of the x-height of the menu's letters at a distance, degrees. */
export function xHeightDegrees(distanceM: number): number {
  return (Math.atan((X_HEIGHT * FONT_M) / distanceM) * 180) / Math.PI;
}

/** Places lines and buttons below each other. */
export function layOut({ lines, groups }: MenuContent): MenuLayout {
  const layout: MenuLayout = { width: MENU_WIDTH_M, height: 0, lines: [], buttons: [] };
  let y = MARGIN_M;
  const addLine = (text: string, isTitle: boolean): void => {
    y += LINE_M;
    layout.lines.push({ text, x: MARGIN_M, y: y - 0.25 * LINE_M, isTitle });
  };
  for (const line of lines) addLine(line, false);
  for (const { title, buttons } of groups) {
    if (buttons.length === 0) continue;
    y += GAP_M;
    if (title !== "") addLine(title, true);
    y = placeButtons(buttons, y + GAP_M, layout);
  }
  layout.height = y + MARGIN_M;
  return layout;
}

/** Places buttons row by row from a height on. Returns the height below them. */
function placeButtons(buttons: readonly MenuButton[], top: number, layout: MenuLayout): number {
  let [column, y] = [0, top];
  for (const button of buttons) {
    const span = Math.min(button.span ?? 1, COLUMNS);
    if (column + span > COLUMNS) {
      column = 0;
      y += BUTTON_M.height + GAP_M;
    }
    const x = MARGIN_M + column * (BUTTON_M.width + GAP_M);
    const width = span * BUTTON_M.width + (span - 1) * GAP_M;
    layout.buttons.push({ button, rect: { x, y, width, height: BUTTON_M.height } });
    column += span;
  }
  return y + BUTTON_M.height;
}

/** The button at a point of the menu; null if there is none. */
export function buttonAt({ buttons }: MenuLayout, x: number, y: number): MenuButton | null {
  const isInside = ({ x: left, y: top, width, height }: Rect): boolean =>
    x >= left && x <= left + width && y >= top && y <= top + height;
  return buttons.find(({ rect }) => isInside(rect))?.button ?? null;
}

/** The first lines of a text that fit into a width, with `widthOf` as the measure. The last one ends with an ellipsis if needed. */
export function wrapped(text: string, width: number, maxLines: number, widthOf: (part: string) => number): string[] {
  const lines: string[] = [];
  let line = "";
  const words = text.split(" ");
  for (const [ix, word] of words.entries()) {
    const longer = line === "" ? word : `${line} ${word}`;
    if (line === "" || widthOf(longer) <= width) {
      line = longer;
      continue;
    }
    if (lines.length === maxLines - 1) {
      return [...lines, cut([line, ...words.slice(ix)].join(" "), width, widthOf)];
    }
    lines.push(line);
    line = word;
  }
  return line === "" ? lines : [...lines, cut(line, width, widthOf)];
}

/** The text, shortened with an ellipsis to a width. */
export function cut(text: string, width: number, widthOf: (part: string) => number): string {
  if (widthOf(text) <= width) return text;
  let end = text.length;
  while (end > 0 && widthOf(`${text.slice(0, end)}…`) > width) end -= 1;
  return `${text.slice(0, end).trimEnd()}…`;
}

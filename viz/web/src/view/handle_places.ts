// Places the handles of a box on the screen. Each handle can be reached, even if its place on the
// box is out of view.

export interface Point {
  x: number;
  y: number;
}

export interface Rect {
  left: number;
  top: number;
  right: number;
  bottom: number;
}

/** A handle's place on the box, projected to the view. */
export interface Anchor extends Point {
  /** Whether it is behind the viewer. In this case, `x` and `y` only have the direction from the middle of the view. */
  isBehind: boolean;
}

export interface HandlePlace extends Point {
  /** Whether it is not at its anchor. */
  isMoved: boolean;
}

/** A handle closer than this to an edge or obstacle cannot be reached, pixels. */
const REACH_PX = 6;
/** Distance of moved handles from the edges of the view, and from toolbars and panels, pixels. */
const MARGIN_PX = 18;
/** Minimum distance of a moved handle from the others, pixels. */
const SPACING_PX = 34;

/** Places handles inside the view, outside of the obstacles, and apart from each other. Pixels. */
export function placeHandles(anchors: Anchor[], view: Rect, obstacles: Rect[]): HandlePlace[] {
  const inside = shrunk(view, MARGIN_PX);
  const isFree = (point: Point, margin: number): boolean =>
    contains(shrunk(view, margin), point) && !obstacles.some((rect) => contains(shrunk(rect, -margin), point));
  const places: (HandlePlace | null)[] = anchors.map((anchor) =>
    !anchor.isBehind && isFree(anchor, REACH_PX) ? { x: anchor.x, y: anchor.y, isMoved: false } : null,
  );
  anchors.forEach((anchor, ix) => {
    if (places[ix]) return;
    const taken = places.filter((place) => place !== null);
    const isApart = (point: Point): boolean =>
      taken.every(({ x, y }) => Math.hypot(x - point.x, y - point.y) >= SPACING_PX);
    const wanted = anchor.isBehind ? atEdge(anchor, inside) : clamped(anchor, inside);
    places[ix] = { ...(nearest(wanted, inside, (point) => isFree(point, MARGIN_PX) && isApart(point)) ?? wanted), isMoved: true };
  });
  return places as HandlePlace[];
}

/** The point of a grid that is acceptable and nearest to the wanted one; null if there is none. */
function nearest(wanted: Point, inside: Rect, isAcceptable: (point: Point) => boolean): Point | null {
  if (isAcceptable(wanted)) return wanted;
  const step = SPACING_PX / 2;
  let best: Point | null = null;
  let bestDistance = Infinity;
  const consider = (point: Point): void => {
    const distance = Math.hypot(point.x - wanted.x, point.y - wanted.y);
    if (distance >= bestDistance || !isAcceptable(point)) return;
    best = point;
    bestDistance = distance;
  };
  for (let x = inside.left; x <= inside.right; x += step) {
    for (let y = inside.top; y <= inside.bottom; y += step) consider({ x, y });
  }
  return best;
}

function clamped({ x, y }: Point, { left, top, right, bottom }: Rect): Point {
  return { x: Math.max(left, Math.min(right, x)), y: Math.max(top, Math.min(bottom, y)) };
}

/** Where the ray from the middle of the view toward a point leaves the rectangle. */
function atEdge(toward: Point, rect: Rect): Point {
  const middle = { x: 0.5 * (rect.left + rect.right), y: 0.5 * (rect.top + rect.bottom) };
  const along = { x: toward.x - middle.x, y: toward.y - middle.y };
  const scales = [
    (0.5 * (rect.right - rect.left)) / Math.abs(along.x),
    (0.5 * (rect.bottom - rect.top)) / Math.abs(along.y),
  ];
  const scale = Math.min(...scales);
  if (!Number.isFinite(scale)) return { x: middle.x, y: rect.bottom };
  return { x: middle.x + scale * along.x, y: middle.y + scale * along.y };
}

function shrunk({ left, top, right, bottom }: Rect, by: number): Rect {
  return { left: left + by, top: top + by, right: right - by, bottom: bottom - by };
}

function contains({ left, top, right, bottom }: Rect, { x, y }: Point): boolean {
  return x >= left && x <= right && y >= top && y <= bottom;
}

// The list from which the user chooses what is compared with the model.

/** What is compared: keyframes that the user chooses, the newest keyframe, or the live images of a camera. */
export type Source = { kind: "stored" } | { kind: "newest" } | { kind: "live"; camera: string };

/** Values of the options. Those of cameras begin with a prefix, because a camera may have any name. */
const STORED = "stored";
const NEWEST = "newest";
const LIVE = "live:";

export class ComparedSource {
  /** What the user has chosen. */
  chosen: Source = { kind: "stored" };
  private listed = "";

  constructor(
    private readonly select: HTMLSelectElement,
    changed: (source: Source) => void,
  ) {
    this.list([]);
    select.addEventListener("change", () => {
      this.chosen = sourceOf(select.value);
      changed(this.chosen);
    });
  }

  /** Chooses a source, as the user does. */
  choose(source: Source): void {
    this.chosen = source;
    this.select.value = valueFor(source);
  }

  /** Shows the cameras that have live images with poses. The chosen one stays in the list. */
  list(cameras: readonly string[]): void {
    const { chosen } = this;
    const all = chosen.kind === "live" && !cameras.includes(chosen.camera) ? [...cameras, chosen.camera] : cameras;
    const listed = JSON.stringify(all);
    if (listed === this.listed) return;
    this.listed = listed;
    this.select.replaceChildren(
      new Option("Stored keyframes", STORED),
      new Option("Newest keyframe", NEWEST),
      ...[...all].sort().map((camera) => new Option(`Live: ${camera}`, `${LIVE}${camera}`)),
    );
    this.select.value = valueFor(chosen);
  }
}

export function sourceOf(value: string): Source {
  if (value.startsWith(LIVE)) return { kind: "live", camera: value.slice(LIVE.length) };
  return value === NEWEST ? { kind: "newest" } : { kind: "stored" };
}

export function valueFor(source: Source): string {
  return source.kind === "live" ? `${LIVE}${source.camera}` : source.kind;
}

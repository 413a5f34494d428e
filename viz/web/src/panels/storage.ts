// The storage of the browser. Browsers can be set to store nothing for a page.

type Place = "localStorage" | "sessionStorage";

/** The text with a key; null if there is none. */
export function stored(key: string, place: Place = "localStorage"): string | null {
  try {
    return window[place].getItem(key);
  } catch {
    return null;
  }
}

/** Stores a text. Returns false if the browser does not. */
export function store(key: string, text: string, place: Place = "localStorage"): boolean {
  try {
    window[place].setItem(key, text);
    return true;
  } catch {
    return false;
  }
}

// On phones, some cards are one line, so that they cover little of the view. A tap opens a card, and another one folds it.
// The styles are in styles/phone_view.css.

const FOLDING = ".coverage, .picture-info, .legend";

export function setUpFolding(): void {
  document.addEventListener("click", ({ target }) => {
    if (!(target instanceof Element) || target.closest("button")) return;
    target.closest(FOLDING)?.classList.toggle("is-open");
  });
}

// Kinds of windows, as media queries. The styles have the same sizes.

/** Windows with space for only one line of a result, and without space for a chart. */
export const SMALL_WINDOW = "(max-width: 820px), (max-height: 500px)";
/** The windows that styles/phone.css regards as phones. */
export const PHONE = "(max-width: 599px), (max-height: 500px)";

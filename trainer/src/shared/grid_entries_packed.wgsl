// grid_entries: number type of the grid's entries: two f16, so that more of the grid fits into the caches.

alias Entry = u32;

fn entry_value(entry: Entry) -> vec2f { return unpack2x16float(entry); }

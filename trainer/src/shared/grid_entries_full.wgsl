// grid_entries: number type of the grid's entries.

alias Entry = vec2f;

fn entry_value(entry: Entry) -> vec2f { return entry; }

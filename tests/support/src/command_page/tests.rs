//! Tests of the page with a small program.

use super::{CommandPage, LINE_CHARS, SharedFlags, table, wrapped};
use clap::{Args, CommandFactory, Parser, Subcommand, ValueEnum};

/// A program.
#[derive(Parser)]
#[command(name = "tool")]
struct Tool {
    /// Log more
    #[arg(short, long, global = true)]
    verbose: bool,
    #[command(subcommand)]
    command: Verb,
}

#[derive(Subcommand)]
enum Verb {
    /// Run it
    Run(RunArgs),
    /// Measure it
    Measure(MeasureArgs),
    /// List runs
    Runs(RunsArgs),
}

#[derive(Args)]
#[command(after_long_help = "States: `done`.\n\nExamples:\n  tool run a.toml\n  tool run b.toml")]
struct RunArgs {
    /// Rig file
    rig_file: String,
    #[command(flatten)]
    page: PageArgs,
    /// Stop after S seconds; needs --listen [default: no limit]
    #[arg(long, value_name = "S", conflicts_with = "steps")]
    seconds: Option<f64>,
    /// Stop after N steps
    #[arg(short = 'n', long, value_name = "N", default_value_t = 5)]
    steps: u64,
    /// What to do
    #[arg(long, value_enum, required = true)]
    kind: Kind,
    /// Not shown
    #[arg(long, hide = true)]
    hidden: bool,
    /// More flags
    #[arg(last = true, value_name = "MORE")]
    more: Vec<String>,
}

#[derive(Clone, Copy, ValueEnum)]
enum Kind {
    /// Quickly
    Fast,
    /// With a|b
    Slow,
}

/// Flags of the page.
#[derive(Args)]
struct PageArgs {
    /// Address of the page
    ///
    /// It is a number.
    #[arg(long)]
    listen: Option<String>,
    /// Also serve topics
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, require_equals = true)]
    topics: Option<String>,
}

#[derive(Args)]
struct MeasureArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// Measure time
    Time(TimeArgs),
}

#[derive(Args)]
struct TimeArgs {
    /// Recordings
    #[arg(required = true)]
    data: Vec<String>,
    #[command(flatten)]
    page: PageArgs,
}

#[derive(Args)]
struct RunsArgs {
    #[command(subcommand)]
    action: Option<Action>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

#[derive(Subcommand)]
enum Action {
    /// Remove runs
    Remove,
}

const PAGE: &str = r#"# Tool

| command | purpose |
|---|---|
| [`run`](#run) | Run it. |
| [`measure`](#measure) | Measure it. |
| [`measure time`](#measure-time) | Measure time. |
| [`runs`](#runs) | List runs. |
| [`runs remove`](#runs-remove) | Remove runs. |

## Shared flags

### Page flags

Accepted by [`run`](#run) and [`measure time`](#measure-time).

| flag | default | meaning |
|---|---|---|
| `--listen LISTEN` |  | Address of the page. It is a number. |
| `--topics[=ADDRESS]` |  | Also serve topics. |

## `run`

Run it.

```
tool run [FLAGS] --kind KIND RIG_FILE [-- MORE]
```

| flag | default | meaning |
|---|---|---|
| `RIG_FILE` | required | Rig file. |
| `--seconds S` | no limit | Stop after S seconds; needs `--listen`. Cannot be combined with `--steps`. |
| `-n, --steps N` | `5` | Stop after N steps. |
| `--kind KIND` | required | What to do. Values: `fast`: Quickly; `slow`: With a\|b. |
| `MORE` |  | More flags. |

`run` also accepts the [page flags](#page-flags).

States: `done`.

```
Examples:
  tool run a.toml
  tool run b.toml
```

Notes.

## `measure`

Measure it.

### `measure time`

Measure time.

```
tool measure time [FLAGS] DATA...
```

| flag | default | meaning |
|---|---|---|
| `DATA` | required | Recordings. |

`measure time` also accepts the [page flags](#page-flags).

## `runs`

List runs.

```
tool runs [FLAGS]
```

| flag | default | meaning |
|---|---|---|
| `--json` |  | Print JSON. |

### `runs remove`

Remove runs.

```
tool runs remove
```

## End
"#;

#[test]
fn page_lists_every_flag_once() {
    let page = CommandPage {
        program: &Tool::command(),
        shared: &[SharedFlags {
            group: "PageArgs",
            title: "Page flags",
        }],
        part: &|name| match name {
            "head" => Some("# Tool\n".to_owned()),
            "run" => Some("Notes.\n".to_owned()),
            "end" => Some("## End\n".to_owned()),
            _ => None,
        },
    };
    let rendered = page.render();
    let lines = |text: &str| text.lines().map(str::to_owned).collect::<Vec<_>>();
    assert_eq!(lines(&rendered), lines(PAGE));
}

#[test]
fn flags_in_help_texts_become_code() {
    assert_eq!(
        table::as_code("needs --sim, `--from a` (or --steps); see [arm.motion]"),
        "needs `--sim`, `--from a` (or `--steps`); see `[arm.motion]`"
    );
    assert_eq!(table::sentence("Print  JSON"), "Print JSON.");
    assert_eq!(table::sentence("Done."), "Done.");
}

#[test]
fn prose_is_wrapped() {
    let text = wrapped(&"word ".repeat(50));
    assert_eq!(text.lines().count(), 3);
    assert!(text.lines().all(|line| line.len() <= LINE_CHARS));
    assert_eq!(text.split_whitespace().count(), 50);
}

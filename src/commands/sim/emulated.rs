//! Prints the progress of emulated devices, and waits until they are no longer needed.

use super::Args;
use crate::exit::{self, Exit};
use crate::{print, signals};
use capture::Stop;
use capture::emulation::{EmulationPlan, Stage};
use drivers::clock;
use kinematics::Stamp;
use std::time::Duration;

/// How often Ctrl-C is checked.
const POLL: Duration = Duration::from_millis(50);

/// Starts the devices, and waits for Ctrl-C.
pub(super) fn run(args: &Args) -> anyhow::Result<Exit> {
    let stop = signals::stop_on_signals()?;
    let plan = EmulationPlan {
        rig_or_scene: args.rig_or_scene.clone(),
        out: args.out.clone(),
        recording: args.from.clone(),
        seconds: args.seconds,
        start_in_secs: args.start_in,
        fci: args.fci.clone(),
        answer_wait: Duration::from_secs_f64(args.answer_wait / 1000.0),
    };
    let bar = print::bar(None, "{spinner} {elapsed} {msg}", args.json);
    let mut last_stage = None;
    let started = plan.start(&stop, &mut |stage, secs| {
        // Each stage has its own time.
        if last_stage.replace(stage) != Some(stage) {
            bar.reset_elapsed();
        }
        let done = match stage {
            Stage::Simulating => "simulated",
            Stage::Preparing => "prepared",
        };
        bar.set_message(format!("{secs:.1} of {:.1} s {done}", args.seconds));
    });
    bar.finish_and_clear();
    let Some(emulation) = started? else {
        return Ok(Exit::Done);
    };
    if args.json {
        print::report_json(&emulation.ready_event(&plan))?;
    } else {
        for device in &emulation.descriptions {
            print::report(device);
        }
        print::report(format_args!(
            "Playing back {:.1} s, starting in {:.1} s. In another terminal: fieldrig run {}",
            args.seconds,
            args.start_in,
            emulation.rig_file.display()
        ));
    }
    wait(&stop, emulation.starts_at, args)?;
    Ok(exit::from_losses(emulation.damage.as_slice()))
}

/// Waits for Ctrl-C. The devices stand still after the playback.
fn wait(stop: &Stop, starts_at: Stamp, args: &Args) -> anyhow::Result<()> {
    let bar = print::bar(None, "{spinner} {msg}", args.json);
    let mut is_over = false;
    while !stop.requested() {
        let secs = clock::now().secs_since(starts_at);
        bar.set_message(match secs {
            ..0.0 => format!("starts in {:.1} s", -secs),
            _ if secs < args.seconds => format!("{secs:.1} of {:.1} s played back", args.seconds),
            _ => "playback has ended; devices stand still until Ctrl-C".to_owned(),
        });
        if secs >= args.seconds && !std::mem::replace(&mut is_over, true) {
            if args.json {
                print::report_json(&serde_json::json!({ "event": "over" }))?;
            } else {
                print::report(
                    "Playback has ended: the emulated devices stand still but respond until Ctrl-C.",
                );
            }
        }
        std::thread::sleep(POLL);
    }
    bar.finish_and_clear();
    Ok(())
}

//! Tests of the whole program `fieldrig` in one program, so that they are linked once and fill all
//! processors.

mod app_window;
mod arrows;
mod bench;
mod bring_up;
mod calibrate;
mod calibrate_eye_to_hand;
mod calibrate_guided;
mod calibrate_mistakes;
mod calibrate_page;
mod calibrate_scan;
mod cases;
mod cli;
mod command;
mod demo;
mod depth_from;
mod edits;
mod end_to_end;
#[cfg(feature = "sim")]
mod exit_codes;
mod file_cycles;
mod fk;
mod gpu_loss;
#[cfg(feature = "sim")]
mod guides;
mod init;
mod metrics_export;
mod output;
#[cfg(feature = "sim")]
mod output_places;
mod page_replay;
#[cfg(feature = "sim")]
mod page_server;
mod paths;
mod photos;
mod pictures;
mod preview;
#[cfg(feature = "realsense")]
mod realsense;
mod received_files;
mod resume;
mod robot_silhouette;
#[cfg(feature = "sim")]
mod run_folder;
mod runs;
mod schema;
#[cfg(feature = "sim")]
mod small_rig;
#[cfg(feature = "sim")]
mod steered_base;
#[cfg(feature = "sim")]
mod steering;
#[cfg(feature = "sim")]
mod steering_client;
#[cfg(feature = "sim")]
mod terminal;
mod together;
mod view;
mod wall;
#[cfg(all(feature = "realsense", feature = "sim"))]
mod wire;
#[cfg(feature = "sim")]
mod wire_session;

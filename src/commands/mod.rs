//! The subcommands, one file each.

pub(crate) mod bench;
pub(crate) mod calibrate;
pub(crate) mod devices;
pub(crate) mod doctor;
pub(crate) mod eval;
pub(crate) mod export;
pub(crate) mod fk;
pub(crate) mod init;
pub(crate) mod metrics;
pub(crate) mod move_arm;
pub(crate) mod preview;
pub(crate) mod record;
pub(crate) mod render;
pub(crate) mod run;
pub(crate) mod runs;
pub(crate) mod schema;
pub(crate) mod sim;
pub(crate) mod train;
pub(crate) mod view;

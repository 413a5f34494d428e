//! Training sessions: train models on keyframes, evaluate them on a schedule, and recover from
//! failures.
//!
//! [`TrainPlan::run`] carries out a whole training run on data from disk, and [`RunPlan::prepare`]
//! begins a live run. A [`Session`] is one model in training with its clock, evaluations,
//! checkpoints and reports. [`Data`] reads keyframes from disk, and [`UnsavedTraining`] trains on
//! them without a run folder. [`LiveLoop`] is the loop of a live run: it takes keyframes from a
//! [`capture::Feed`] and draws pictures for viewers. [`finish`] saves and scores the models.
//! Timing-dependent decisions are logged ([`DecisionLog`]) and can be replayed. An [`Observer`]
//! receives all reports.
//!
//! ```
//! use keyframe::{Keyframe, Split};
//! use session::{DataOptions, Limits, limits};
//!
//! // Training stops after ten seconds unless another limit is given.
//! assert_eq!(limits(None, None, 10.0)?.describe(), "10 s");
//! assert_eq!(limits(None, Some(500), 10.0)?.describe(), "500 steps");
//! assert!(limits(Some(-1.0), None, 10.0).is_err());
//! // Every 10th image is a test image.
//! let options = DataOptions { holdout: Some("10".into()), ..DataOptions::default() };
//! assert!(options.holdout()?.is_some());
//! # Ok::<(), anyhow::Error>(())
//! ```

mod advice;
pub mod camera_list;
mod camera_path;
pub mod checkpoints;
mod chunk_publisher;
pub mod corrected_rig;
mod data;
mod dataset_export;
mod decisions;
pub mod depth_from;
mod edited_copy;
mod editing;
mod error;
mod eval_plan;
pub mod evaluate;
pub mod evaluation_schedule;
mod event_texts;
mod export_plan;
mod gpu_check;
mod gpu_loss;
mod holdout;
mod image_comparison;
mod incident_view;
mod kept_folder;
mod latency;
mod ledger;
mod likely_cause;
mod live_loop;
mod method_options;
pub mod methods;
mod model_source;
mod models_verdict;
pub mod next_commands;
mod observations;
mod observer;
mod page_check;
mod pending_evaluation;
mod photographs;
mod preview;
mod previous_run;
mod progress_lines;
mod read_progress;
mod recent_images;
pub mod recoveries;
pub mod recovery;
mod render_budget;
mod render_plan;
mod rendered_files;
mod report;
mod resume_command;
pub mod robot_meshes;
pub mod run_folder;
pub mod run_log;
mod run_plan;
mod run_state;
pub mod runs;
mod saved_view;
mod scene_calibration;
pub mod scene_hint;
mod served_files;
mod session;
mod session_setup;
mod started_run;
mod steering;
mod stored_keyframes;
mod stored_robot;
mod time_slices;
mod train_plan;
mod training;
mod training_clock;
mod training_options;
pub mod verdict;
mod viewer;
mod viewers;

pub use checkpoints::{CheckpointOptions, Checkpoints, RunFlags, parse_period};
pub use data::{Data, DataOptions, Purpose, expect, points_sha256};
pub use dataset_export::{RecordingExport, Written, write_nerfstudio};
pub use decisions::{DecisionLog, RunDescription, Settings};
pub use error::{class, is_gpu_error, is_gpu_unrecoverable};
pub use eval_plan::{EvalOutcome, EvalPlan, NamedScores};
pub use evaluate::Evaluator;
pub use event_texts::end_lines;
pub use export_plan::{CheckedExport, ExportPlan, ModelExport, NERFSTUDIO, export_formats};
pub use gpu_check::{gpu_device, gpu_findings};
pub use gpu_loss::lose_gpu_at_step;
pub use image_comparison::{ComparisonScores, ImageComparison};
pub use kept_folder::KeptFolder;
pub use latency::Latency;
pub use ledger::{KeyframeTimes, Ledger, latencies};
pub use live_loop::{EndedLoop, KeyframeChange, LiveLoop, LiveOptions, Pace};
pub use methods::{methods_in, methods_of};
pub use observer::{
    DoneEvent, Evaluation, FinishedReport, Observer, ProfileEvent, SessionEvent, SessionProgress,
};
pub use page_check::page_finding;
pub use preview::Preview;
pub use previous_run::FinishedRun;
pub use progress_lines::ProgressLines;
pub use read_progress::{OnReadProgress, ReadProgress, ignore_progress};
pub use recoveries::OpenGpu;
pub use recovery::Recovery;
pub use render_plan::{OnPicture, RenderPlan, RenderedCameras, RenderedPicture};
pub use resume_command::ResumeCommand;
pub use run_plan::{
    DiscardedRun, EndedRun, OpenedRun, PreparedRun, PreviousLiveRun, RunInProgress, RunInput,
    RunPlan, SavedRun,
};
pub use saved_view::{check_is_model, load_saved, model_from_page};
pub use scene_calibration::{RelativePose, SCENE_PARAMS, SceneCalibration, calibrate_scene};
pub use session::{
    EndViewers, EndingSession, Evaluators, FinishedModel, Limits, Persistence, Scoreboard, Session,
    SessionOptions, TrainingOutcome, TrainingTime, finish,
};
pub use session_setup::{NewObserver, Services};
pub use started_run::StartedRun;
pub use steering::{
    SteeringThread, Surroundings, drive_standalone, steer_standalone, steering_log,
};
pub use stored_keyframes::StoredKeyframes;
pub use train_plan::{TrainOutcome, TrainPlan, Trained};
pub use training::{UnsavedTraining, check_before_data, limits, model_specs};
pub use training_clock::Clock;
pub use training_options::{AvailableData, REALIGN, Refine, RefineSettings, TrainingOptions};
pub use viewer::{ModelViewer, ServedModel};
pub use viewers::Viewers;

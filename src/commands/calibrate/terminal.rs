//! Signals, progress bars and the page of calibrations.

use crate::console::ReadBar;
use crate::page_args::PageArgs;
use crate::{print, signals};
use anyhow::Context;
use calibrate::{Activity, CameraView, GuidancePage, Host};
use calibration::{BoardView, LensCoverage};
use capture::Stop;
use capture::config::Camera;
use drivers::Image;
use indicatif::ProgressBar;
use session::ReadProgress;
use viz::{Hub, ServedPage};

/// The terminal in which a calibration runs.
pub(super) struct Terminal<'a> {
    /// How the page is served. `None` for a calibration without a target, because it has no page.
    page: Option<&'a PageArgs>,
    /// Whether nothing but the result is printed.
    is_json: bool,
    bar: ReadBar,
}

impl<'a> Terminal<'a> {
    /// A terminal without progress bars if the result is JSON.
    pub(super) fn new(page: Option<&'a PageArgs>, is_json: bool) -> Self {
        Self {
            page,
            is_json,
            bar: ReadBar::new(is_json),
        }
    }
}

impl Host for Terminal<'_> {
    fn stop_requests(&self, activity: Activity) -> anyhow::Result<Stop> {
        match activity {
            Activity::ReadImages => signals::stop_on_signals_logging(
                "calibrating with the images so far; Ctrl-C again exits at once",
            ),
            Activity::MoveArm { is_simulated } => {
                let stop = signals::stop_on_signals_logging(
                    "bringing the arm to rest, then calibrating; Ctrl-C again applies on_loss at once",
                )?;
                if !is_simulated {
                    signals::stop_when_output_closes(&stop)?;
                }
                Ok(stop)
            }
        }
    }

    fn on_progress(&self, progress: ReadProgress) {
        self.bar.show(progress);
    }

    fn on_progress_end(&self) {
        self.bar.end();
    }

    fn open_view(
        &self,
        camera: &Camera,
        activity: Activity,
    ) -> anyhow::Result<Box<dyn CameraView>> {
        let page = self
            .page
            .context("this calibration shows no images of a camera")?;
        // The motions of an arm are logged, so that they can be read afterwards.
        let is_hidden = self.is_json || activity != Activity::ReadImages;
        // The bar is created first, so that the addresses of the page are printed above it.
        let bar = print::bar(None, "{spinner} {msg}", is_hidden);
        let hub = Hub::new();
        // The page is only an aid, so a port that is in use must not prevent the calibration.
        let server = page.serve_or_free_port(&hub)?;
        // The address is printed to stderr, because stdout contains only the result.
        print::notice("the page shows camera images and what to do next:");
        server.lines().iter().for_each(print::notice);
        page.open_window(&server)?;
        Ok(Box::new(TerminalView {
            bar,
            page: GuidancePage::new(hub, camera),
            _server: server,
        }))
    }
}

/// Shows advice on the page and in a progress bar, or as lines if stderr is not a terminal.
struct TerminalView {
    bar: ProgressBar,
    page: GuidancePage,
    /// The server stops when it is dropped.
    _server: ServedPage,
}

impl CameraView for TerminalView {
    fn show_live(&mut self, image: &Image) {
        // This only moves the spinner.
        self.bar.inc(1);
        self.page.show_live(image);
    }

    fn show_searched(&mut self, size_px: [u32; 2], gray: &[u8], view: Option<&BoardView>) {
        self.page.show_searched(size_px, gray, view);
    }

    fn show_coverage(&mut self, coverage: &LensCoverage) {
        self.page.set_coverage(coverage);
    }

    fn advise(&mut self, text: &str) {
        self.page.guide(text);
        // A hidden bar does not print its messages. The bar is hidden, for example, if stderr is a
        // file.
        if self.bar.is_hidden() {
            log::info!("{text}");
        } else {
            self.bar.set_message(text.to_owned());
        }
    }

    fn finish(&mut self) {
        self.bar.finish_and_clear();
        self.page.finish();
    }
}

impl Drop for TerminalView {
    fn drop(&mut self) {
        // The bar is removed before an error is shown.
        self.bar.finish_and_clear();
    }
}

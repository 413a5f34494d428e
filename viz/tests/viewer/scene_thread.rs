//! A thread that draws the requested pictures of the analytic scene, and records their requests.

use crate::request_thread::RequestThread;
use analytic_scene::draw;
use std::sync::{Arc, Mutex};
use test_support::browser::{Browser, canvas_bounds, wait_for};
use trainer::{Projection, RenderRequest};
use viz::Hub;

/// Draws pictures until it is dropped.
pub(crate) struct SceneThread {
    requests: Arc<Mutex<Vec<RenderRequest>>>,
    _thread: RequestThread,
}

impl SceneThread {
    pub(crate) fn start(hub: Hub) -> Self {
        let requests: Arc<Mutex<Vec<RenderRequest>>> = Arc::default();
        let received = Arc::clone(&requests);
        let thread = RequestThread::start(hub, move |pending| {
            // Panoramas are requested for the surroundings of the view.
            if pending.request.projection != Projection::Equirectangular {
                let request = pending.request.clone();
                received.lock().expect("no panic").push(request);
            }
            let picture = draw(&pending.request);
            pending.deliver(picture);
        });
        Self {
            requests,
            _thread: thread,
        }
    }

    /// The newest request of the main view.
    pub(crate) fn last_request(&self) -> Option<RenderRequest> {
        self.requests.lock().expect("no panic").last().cloned()
    }
}

/// Waits for a picture in full resolution that has this property, and returns its request.
pub(crate) fn full_request(
    browser: &mut Browser,
    pictures: &SceneThread,
    what: &str,
    mut is_expected: impl FnMut(&RenderRequest) -> bool,
) -> RenderRequest {
    let mut full = None;
    wait_for(browser, what, |browser| {
        let [.., width, height] = canvas_bounds(browser);
        full = pictures
            .last_request()
            .filter(|request| request.size_px == [width, height] && is_expected(request));
        full.is_some()
    });
    full.expect("the wait has ended")
}

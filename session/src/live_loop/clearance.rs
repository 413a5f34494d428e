//! Draws the depth that an arm needs to keep its distance, from the first model.

use super::LiveLoop;
use crate::steering::{ClearanceFeed, MIN_STEPS};
use std::time::Instant;

impl LiveLoop {
    /// From now on, depth is drawn for keyframes without depth.
    pub(crate) fn draw_clearance_for(&mut self, feed: ClearanceFeed) {
        self.clearance = Some(feed);
    }

    /// Draws depth at the pose of one keyframe, if one is due. The time comes from that of viewers,
    /// so that training keeps its share.
    pub(super) fn draw_clearance(&mut self) -> anyhow::Result<()> {
        let session = &mut self.models.sessions[0];
        let Some(feed) = &mut self.clearance else {
            return Ok(());
        };
        if !self.budget.may_render() || session.progress().step < MIN_STEPS {
            return Ok(());
        }
        let before = Instant::now();
        let Some(undrawn) = feed.next(before) else {
            return Ok(());
        };
        let (picture, world_from_camera) = session.viewed().draw_keyframe(&undrawn.keyframe)?;
        feed.drawn(undrawn, world_from_camera, &picture);
        self.budget.add_render(before.elapsed());
        Ok(())
    }
}

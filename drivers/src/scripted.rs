//! A source with given samples, for tests.

use crate::{Error, Image, PixelFormat, Sample, Source};
use kinematics::{JointState, Stamp};

/// Returns samples in their given order.
pub(crate) struct Scripted(std::vec::IntoIter<Sample>);

impl Scripted {
    pub(crate) fn new(samples: Vec<Sample>) -> Self {
        Self(samples.into_iter())
    }
}

impl Source for Scripted {
    fn next_sample(&mut self) -> Result<Option<Sample>, Error> {
        Ok(self.0.next())
    }
}

/// An image of one pixel.
pub(crate) fn image(stamp: Stamp) -> Image {
    Image {
        camera: "wrist".into(),
        stamp,
        size_px: [1, 1],
        format: PixelFormat::Rgb8,
        data: [0; 3].into(),
        exposure_secs: None,
        n_skipped: 0,
    }
}

/// A state of one joint.
pub(crate) fn joints(stamp: Stamp) -> Sample {
    Sample::Joints(JointState {
        stamp,
        position: vec![0.0],
        velocity: Vec::new(),
        effort: Vec::new(),
    })
}

//! The depth of a keyframe as colored points, for viewers.

use crate::Hub;
use crate::client::server_message::{BinaryHeader, PointsHeader, frame};
use crate::topics::keyframes::{PublishedKeyframes, SharedLog};
use crate::topics::positions::pack_positions;
use crate::topics::{
    ClientState, DefaultRate, EncodeContext, Feed, Priority, Publisher, Timer, Topic, TopicEntry,
    receiver, take_if_changed,
};
use axum::extract::ws::Message;
use keyframe::{DepthMap, Keyframe};
use kinematics::Stamp;
use nalgebra::{Point3, Vector3};
use parking_lot::Mutex;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Weak};
use std::time::Instant;
use tokio::sync::watch;

/// Maximum number of points per keyframe. A run has hundreds of keyframes that overlap. With 9
/// bytes per point, a keyframe has 22 kB.
const MAX_POINTS: usize = 2500;
/// Points whose depth differs from a neighbor's depth by more than this fraction are left out. They
/// lie on edges, where depth cameras report values between the two depths. With a smaller fraction,
/// surfaces seen at a grazing angle would lose their points, too. With a larger fraction, points
/// would float behind edges.
const MAX_EDGE_FRAC: f64 = 0.05;

/// Name in `subscribe`.
const NAME: &str = "keyframe_points";

/// The topic in the table.
pub(crate) const ENTRY: TopicEntry = TopicEntry {
    name: NAME,
    default: DefaultRate::Off,
    priority: Priority::Keyframes,
    capability: Some(NAME),
    start: |hub| Arc::new(PointTopic::new(hub)),
};

/// Keyframes whose points clients can draw, by camera and stamp. The run owns them and may drop
/// them at any time.
type KeyframeSources = BTreeMap<(Arc<str>, i64), Weak<Keyframe>>;

/// The topic.
pub(crate) struct PointTopic {
    log: Mutex<watch::Receiver<SharedLog>>,
    points: Arc<Mutex<Points>>,
}

/// The points that were packed.
#[derive(Default)]
struct Points {
    /// Messages by number of the keyframe; `None` for keyframes without points.
    messages: BTreeMap<u64, Option<Message>>,
    is_running: bool,
}

impl PointTopic {
    /// A topic for the keyframes of a hub.
    pub(crate) fn new(hub: &Hub) -> Self {
        Self {
            log: Mutex::new(receiver(hub)),
            points: Arc::default(),
        }
    }

    /// Sets the messages of all keyframes without packing.
    #[cfg(test)]
    pub(crate) fn set(&self, messages: BTreeMap<u64, Option<Message>>) {
        self.points.lock().messages = messages;
    }
}

impl Topic for PointTopic {
    fn encode(&self, context: &EncodeContext<'_>) {
        let mut log = self.log.lock();
        let mut points = self.points.lock();
        if let Some(Some(log)) = take_if_changed(&mut log) {
            // Points of removed keyframes would fill the memory in a long run.
            points.messages.retain(|number, _| log.contains(*number));
        }
        let is_wanted = context
            .settled()
            .any(|demand| demand.subscriptions.period(NAME).is_some());
        // One keyframe at a time, so that packing takes at most one processor away from training.
        if !is_wanted || points.is_running {
            return;
        }
        let log = log.borrow();
        let mut newest_first = log.iter().flat_map(|log| log.newest_first());
        // The newest keyframes come first, because they show where the robot is now.
        let Some((number, pose)) =
            newest_first.find(|(number, _)| !points.messages.contains_key(number))
        else {
            return;
        };
        points.is_running = true;
        // `None` if the run has dropped the keyframe in the meantime. The keyframe then counts as
        // one without points, and is not looked up again.
        let source = context.hub.keyframes().source(&pose.camera, pose.stamp);
        let task = PackingTask {
            number,
            points: Arc::clone(&self.points),
            publisher: context.publisher.clone(),
        };
        tokio::task::spawn_blocking(move || task.run(source.as_deref()));
    }

    fn clear(&self) {
        self.points.lock().messages.clear();
    }

    fn feed(self: Arc<Self>) -> Box<dyn Feed> {
        let log = self.log.lock().clone();
        let points = Arc::clone(&self.points);
        Box::new(PointFeed {
            log,
            points,
            sent: BTreeSet::new(),
            sent_at: None,
            n_subscriptions: 0,
            n_lists: 0,
        })
    }
}

/// Packs the points of one keyframe. If that panics, the keyframe has no points, because another
/// attempt would fail, too.
struct PackingTask {
    number: u64,
    points: Arc<Mutex<Points>>,
    publisher: Publisher,
}

impl PackingTask {
    fn run(self, keyframe: Option<&Keyframe>) {
        let packed = keyframe.and_then(|keyframe| pack_points(self.number, keyframe));
        self.publisher.publish(|_| {
            self.points
                .lock()
                .messages
                .insert(self.number, packed.map(Message::binary));
        });
    }
}

impl Drop for PackingTask {
    fn drop(&mut self) {
        let mut points = self.points.lock();
        // This has an effect only after a panic. Otherwise, `run` has already inserted the message.
        points.messages.entry(self.number).or_insert(None);
        points.is_running = false;
    }
}

/// What a client has received.
struct PointFeed {
    log: watch::Receiver<SharedLog>,
    points: Arc<Mutex<Points>>,
    /// Numbers of the keyframes whose points were sent, and the time of the last ones.
    sent: BTreeSet<u64>,
    sent_at: Option<Instant>,
    /// Number of the subscription, and of the keyframe list, that these points belong to.
    n_subscriptions: u64,
    n_lists: u64,
}

impl Feed for PointFeed {
    /// The points of the newest keyframe that the client has without points.
    fn next(&mut self, client: &mut ClientState<'_>, timer: &mut Timer) -> Option<Message> {
        // Clients discard points together with their keyframes, and a new subscription begins with
        // all points.
        let n_subscriptions = client.subscriptions.number(NAME);
        let n_lists = client.keyframes.n_lists;
        if n_subscriptions != self.n_subscriptions || n_lists != self.n_lists {
            self.n_subscriptions = n_subscriptions;
            self.n_lists = n_lists;
            self.sent.clear();
        }
        let period = client.subscriptions.period(NAME)?;
        let log = self.log.borrow();
        // Complete lists have no numbers to which the points could belong.
        let log = log.as_ref().filter(|_| client.has_keyframe_changes)?;
        let points = self.points.lock();
        // A number is never used for a second keyframe, so the numbers of removed keyframes are no
        // longer needed.
        self.sent
            .retain(|number| points.messages.contains_key(number));
        let mut newest_first = points.messages.iter().rev();
        let (number, message) = newest_first.find_map(|(number, message)| {
            // Clients drop points without a keyframe, so the keyframe must have been sent before.
            let is_next =
                !self.sent.contains(number) && log.is_sent(*number, client.keyframes.position);
            Some((number, message.as_ref()?)).filter(|_| is_next)
        })?;
        if !timer.is_due(self.sent_at, period) {
            return None;
        }
        self.sent.insert(*number);
        self.sent_at = Some(timer.now);
        Some(message.clone())
    }
}

impl PublishedKeyframes<'_> {
    /// Sets the keyframes of which clients can draw points. They are not kept alive.
    pub fn set_sources<'a>(&self, keyframes: impl IntoIterator<Item = &'a Arc<Keyframe>>) {
        let key = |keyframe: &Keyframe| (Arc::clone(&keyframe.camera), keyframe.stamp.0);
        let sources = keyframes
            .into_iter()
            .map(|keyframe| (key(keyframe), Arc::downgrade(keyframe)));
        self.hub
            .latest::<KeyframeSources>()
            .send_replace(sources.collect());
    }

    /// The keyframe with this camera and stamp, if the run still has it.
    pub(crate) fn source(&self, camera: &Arc<str>, stamp: Stamp) -> Option<Arc<Keyframe>> {
        self.hub
            .latest::<KeyframeSources>()
            .borrow()
            .get(&(Arc::clone(camera), stamp.0))?
            .upgrade()
    }
}

/// The binary message with the points of a keyframe; `None` if it has no usable depth.
fn pack_points(id: u64, keyframe: &Keyframe) -> Option<Vec<u8>> {
    // A depth map of a wrong size would be indexed out of bounds.
    let is_complete = |depth: &&DepthMap| depth.depth_m.len() == n_pixels(depth.size_px);
    let (points, colors) = points_in_camera(keyframe, keyframe.depth.as_ref().filter(is_complete)?);
    let (positions, meters_per_count) = pack_positions(&points)?;
    let header = PointsHeader {
        id,
        n_points: points.len(),
        meters_per_count,
    };
    Some(frame(
        &BinaryHeader::KeyframePoints(header),
        &[&positions, &colors],
    ))
}

fn n_pixels([width, height]: [u32; 2]) -> usize {
    width as usize * height as usize
}

/// Points on a regular grid of the depth map, in the frame of the keyframe's color camera, and
/// their colors.
fn points_in_camera(keyframe: &Keyframe, depth: &DepthMap) -> (Vec<Vector3<f64>>, Vec<u8>) {
    let n_px = n_pixels(depth.size_px);
    // The same stride along both axes keeps the points evenly distributed.
    let stride = (1..)
        .find(|stride: &usize| n_px / (stride * stride) <= MAX_POINTS)
        .unwrap_or(1);
    // Depth cameras may have another pose than the color camera.
    let camera_from_depth = keyframe.world_from_camera.inverse() * depth.world_from_camera;
    let [width, height] = depth.size_px;
    let mut points = Vec::new();
    let mut colors = Vec::new();
    for y in grid_positions(height, stride) {
        for x in grid_positions(width, stride) {
            let z_m = depth_at(depth, [x, y]);
            // NaN and 0 mean that nothing was measured.
            if z_m.is_nan() || z_m <= 0.0 || is_edge(depth, [x, y]) {
                continue;
            }
            let point = camera_from_depth * Point3::from(depth.point(x, y, z_m));
            let Some(color) = color_at(keyframe, &point) else {
                continue;
            };
            points.push(point.coords);
            colors.extend(color);
        }
    }
    (points, colors)
}

/// Every `stride`-th pixel along a side, starting at half a stride, so that the grid is centered.
fn grid_positions(side: u32, stride: usize) -> impl Iterator<Item = u32> {
    (stride as u64 / 2..u64::from(side))
        .step_by(stride)
        .filter_map(|position| u32::try_from(position).ok())
}

/// Depth of a pixel, meters.
fn depth_at(depth: &DepthMap, [x, y]: [u32; 2]) -> f64 {
    f64::from(depth.depth_m[(y * depth.size_px[0] + x) as usize])
}

/// Whether the depth changes suddenly between a pixel and its neighbors on the right and below.
fn is_edge(depth: &DepthMap, [x, y]: [u32; 2]) -> bool {
    let [width, height] = depth.size_px;
    let z_m = depth_at(depth, [x, y]);
    // An edge to the neighbor on the left or above is detected at that neighbor.
    let neighbors = [[x + 1, y], [x, y + 1]]
        .into_iter()
        .filter(|[x, y]| *x < width && *y < height);
    neighbors
        .map(|neighbor| depth_at(depth, neighbor))
        .any(|other| (other - z_m).abs() > MAX_EDGE_FRAC * z_m)
}

/// Color of the pixel onto which a point projects; `None` outside the image.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "pixels inside the image"
)]
fn color_at(keyframe: &Keyframe, point: &Point3<f64>) -> Option<[u8; 3]> {
    let [width, height] = keyframe.size_px;
    let u = keyframe.focal_px[0] * point.x / point.z + keyframe.principal_px[0];
    let v = keyframe.focal_px[1] * point.y / point.z + keyframe.principal_px[1];
    // The comparisons are written so that a NaN is not inside.
    let is_inside = point.z > 0.0
        && (0.0..f64::from(width)).contains(&u)
        && (0.0..f64::from(height)).contains(&v);
    if !is_inside {
        return None;
    }
    let pixel = 4 * (v as usize * width as usize + u as usize);
    keyframe.rgba_srgb.get(pixel..pixel + 3)?.try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::{MAX_POINTS, pack_points};
    use keyframe::{DepthMap, Keyframe, Split};
    use kinematics::{Stamp, Transform};

    /// A wall at z = 2 m with a box at 1 m in its right half; red on the left, blue on the right.
    fn wall(size_px: [u32; 2]) -> Keyframe {
        let is_right = |ix: u32| ix % size_px[0] >= size_px[0] / 2;
        let pixels = || 0..size_px[0] * size_px[1];
        let rgba = pixels().flat_map(|ix| {
            if is_right(ix) {
                [0, 0, 200, 255]
            } else {
                [200, 0, 0, 255]
            }
        });
        let world_from_camera = Transform::translation(5.0, 0.0, 0.0);
        let (focal_px, principal_px) = ([100.0; 2], size_px.map(|side| 0.5 * f64::from(side)));
        Keyframe {
            camera: "wrist".into(),
            stamp: Stamp(1),
            size_px,
            focal_px,
            principal_px,
            rgba_srgb: rgba.collect(),
            depth: Some(DepthMap {
                size_px,
                focal_px,
                principal_px,
                depth_m: pixels()
                    .map(|ix| if is_right(ix) { 1.0 } else { 2.0 })
                    .collect(),
                world_from_camera,
            }),
            world_from_camera,
            twist: None,
            readout_secs: 0.0,
            joint_twists: [].into(),
            base: None,
            split: Split::Train,
            truth: None,
            robot: None,
        }
    }

    #[test]
    fn points_have_positions_and_colors_of_the_surface() {
        let message = pack_points(7, &wall([160, 120])).expect("points");
        let n_header = u32::from_le_bytes(message[..4].try_into().expect("4 bytes")) as usize;
        let header: serde_json::Value =
            serde_json::from_slice(&message[4..4 + n_header]).expect("JSON");
        let n = usize::try_from(header["n_points"].as_u64().expect("a number")).expect("small");
        assert!(
            header["id"] == 7 && n <= MAX_POINTS && n > MAX_POINTS / 4,
            "{header}"
        );
        let (positions, colors) = message[4 + n_header..].split_at(6 * n);
        assert_eq!(colors.len(), 3 * n);
        let scale = header["meters_per_count"].as_f64().expect("a scale");
        let coordinate = |bytes: &[u8]| f64::from(i16::from_le_bytes([bytes[0], bytes[1]])) * scale;
        let (mut n_left, mut n_right) = (0, 0);
        for (position, color) in positions.chunks_exact(6).zip(colors.chunks_exact(3)) {
            let [x, z] = [coordinate(&position[..2]), coordinate(&position[4..])];
            // The points are in the frame of the camera, not of the world.
            let (expected_z, expected_color) = if x < 0.0 {
                (2.0, [200, 0, 0])
            } else {
                (1.0, [0, 0, 200])
            };
            assert!(
                (z - expected_z).abs() < 1e-3 && color == expected_color,
                "{x} {z} {color:?}"
            );
            *(if x < 0.0 { &mut n_left } else { &mut n_right }) += 1;
        }
        assert!(n_left > n / 3 && n_right > n / 3, "{n_left} {n_right}");
    }

    #[test]
    fn keyframes_without_depth_have_no_points() {
        let mut keyframe = wall([16, 12]);
        keyframe.depth = keyframe.depth.map(|depth| DepthMap {
            depth_m: vec![0.0; 192].into(),
            ..depth
        });
        assert!(pack_points(1, &keyframe).is_none());
        keyframe.depth = wall([16, 12]).depth.map(|depth| DepthMap {
            depth_m: vec![1.0; 191].into(),
            ..depth
        });
        assert!(pack_points(1, &keyframe).is_none(), "a value is missing");
        assert!(
            pack_points(
                1,
                &Keyframe {
                    depth: None,
                    ..keyframe
                }
            )
            .is_none()
        );
    }
}

//! A picture of a rig to scale: a side view and a top view, as SVG.

use super::RigFacts;
use super::camera::CameraFacts;
use nalgebra::{Point2, Point3, Vector3};
use std::fmt::Write;

/// Width and height of the area of a view, pixels.
const VIEW_PX: f64 = 460.0;
/// Space around a view, pixels. It has the heading and the labels at the edges.
const MARGIN_PX: f64 = 60.0;
/// Radius of the smallest picture, meters. A single camera has no size.
const MIN_RADIUS_M: f64 = 0.3;
/// Length of the drawn axes of world and flange, relative to the radius of the scene.
const AXIS_FRAC: f64 = 0.12;
/// Depth to which fields of view are drawn, relative to the radius of the scene.
const FRUSTUM_FRAC: f64 = 0.35;
/// Space that a label needs, pixels.
const LABEL_PX: [f64; 2] = [60.0, 14.0];
/// Colors of the cameras, in their order.
const CAMERA_COLORS: [&str; 6] = [
    "#0a6ebd", "#b35900", "#1b7f3b", "#8a2be2", "#b0006d", "#00767a",
];

/// A direction from which the rig is drawn.
struct View {
    heading: &'static str,
    /// Horizontal and vertical coordinates of a point in the world, meters.
    project: fn(&Point3<f64>) -> Point2<f64>,
    /// Names of the two axes.
    axes: [&'static str; 2],
}

const VIEWS: [View; 2] = [
    View {
        heading: "side view",
        project: |point| Point2::new(point.x, point.z),
        axes: ["x", "z"],
    },
    View {
        heading: "top view",
        project: |point| Point2::new(point.x, point.y),
        axes: ["x", "y"],
    },
];

/// Lines, areas and labels of a rig in the world frame.
struct Scene {
    /// Positions that the flange reaches.
    reached: Vec<Point3<f64>>,
    bones: Vec<[Point3<f64>; 2]>,
    base: Point3<f64>,
    /// Origin and axes of the flange; `None` without an arm.
    flange: Option<(Point3<f64>, [Vector3<f64>; 3])>,
    cameras: Vec<Frustum>,
    scanners: Vec<(String, Point3<f64>)>,
    center: Point3<f64>,
    /// Half the side of the cube that is drawn, meters.
    radius_m: f64,
}

/// The field of view of a camera.
struct Frustum {
    name: String,
    eye: Point3<f64>,
    /// End of the drawn part of the optical axis.
    target: Point3<f64>,
    /// Ends of the rays through the corners of the image, in order; empty if the lens is unknown.
    corners: Vec<Point3<f64>>,
    has_mistake: bool,
}

/// Draws a rig with its joints at rest. A moving base is at the origin of the world. Cameras with an
/// unknown pose are left out, and of cameras with an unknown lens, only the optical axis is drawn.
#[must_use]
pub fn svg(facts: &RigFacts) -> String {
    let scene = Scene::of(facts);
    let panel_px = VIEW_PX + 2.0 * MARGIN_PX;
    let width_px = panel_px * VIEWS.len() as f64;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width_px}\" height=\"{panel_px}\" viewBox=\"0 0 {width_px} {panel_px}\" \
         font-family=\"sans-serif\" font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
    );
    for (ix, view) in VIEWS.iter().enumerate() {
        let mut panel = Panel {
            view,
            scene: &scene,
            left_px: panel_px * ix as f64 + MARGIN_PX,
            labels_px: Vec::new(),
            svg: &mut svg,
        };
        panel.draw();
    }
    svg.push_str("</svg>\n");
    svg
}

impl Scene {
    fn of(facts: &RigFacts) -> Self {
        let world_from_base = &facts.world_from_base;
        let in_world = |point: &Point3<f64>| world_from_base * point;
        let reached: Vec<_> = facts
            .arm
            .iter()
            .flat_map(|arm| arm.reached_in_base.iter().map(in_world))
            .collect();
        let bones: Vec<_> = facts
            .bones
            .iter()
            .map(|bone| bone.ends_in_base.each_ref().map(in_world))
            .collect();
        let base = in_world(&Point3::origin());
        let eyes = facts.cameras.iter().filter_map(|camera| {
            let pose = camera.world_from_camera?;
            Some(pose * Point3::origin())
        });
        let scanners: Vec<_> = facts
            .scanners
            .iter()
            .map(|scanner| {
                let origin = world_from_base * scanner.base_from_scanner * Point3::origin();
                (scanner.name.to_string(), origin)
            })
            .collect();
        let places: Vec<_> = reached
            .iter()
            .chain(bones.iter().flatten())
            .copied()
            .chain(eyes)
            .chain(scanners.iter().map(|(_, origin)| *origin))
            .chain([base, Point3::origin()])
            .collect();
        let (_, places_radius_m) = bounds(&places);
        let frustum_m = FRUSTUM_FRAC * places_radius_m;
        let cameras: Vec<_> = facts
            .cameras
            .iter()
            .filter_map(|camera| Frustum::of(camera, frustum_m))
            .collect();
        let drawn: Vec<_> = cameras
            .iter()
            .flat_map(|camera| camera.corners.iter().chain([&camera.target]))
            .chain(&places)
            .copied()
            .collect();
        let (center, radius_m) = bounds(&drawn);
        let flange = facts.arm.as_ref().map(|arm| {
            let pose = world_from_base * arm.base_from_flange;
            let axes = [Vector3::x(), Vector3::y(), Vector3::z()].map(|axis| pose.rotation * axis);
            (pose * Point3::origin(), axes)
        });
        Self {
            reached,
            bones,
            base,
            flange,
            cameras,
            scanners,
            center,
            radius_m,
        }
    }
}

/// Center and half the side of the smallest cube with all points.
fn bounds(points: &[Point3<f64>]) -> (Point3<f64>, f64) {
    let start = [
        Point3::from([f64::INFINITY; 3]),
        Point3::from([f64::NEG_INFINITY; 3]),
    ];
    let [lower, upper] = points.iter().fold(start, |[lower, upper], point| {
        [lower.inf(point), upper.sup(point)]
    });
    let radius_m = 0.5 * (upper - lower).max();
    (nalgebra::center(&lower, &upper), radius_m.max(MIN_RADIUS_M))
}

impl Frustum {
    fn of(camera: &CameraFacts, frustum_m: f64) -> Option<Self> {
        let pose = camera.world_from_camera?;
        // Nothing is measured beyond the farthest depth.
        let depth_m = camera
            .depth_range_m
            .map_or(frustum_m, |[_, farthest_m]| frustum_m.min(farthest_m));
        let corners = camera.intrinsics.as_ref().map_or_else(Vec::new, |lens| {
            let [width, height] = lens.size_px.map(f64::from);
            [[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]]
                .into_iter()
                .filter_map(|corner| lens.unproject(corner))
                // Rays have the same length, so that wide lenses do not dominate the picture.
                .map(|ray| pose * Point3::from(ray.normalize() * depth_m))
                .collect()
        });
        Some(Self {
            name: camera.name.to_string(),
            eye: pose * Point3::origin(),
            target: pose * Point3::new(0.0, 0.0, depth_m),
            corners,
            has_mistake: camera.looks_into_flange_at_m.is_some(),
        })
    }
}

/// One view while it is drawn.
struct Panel<'a> {
    view: &'a View,
    scene: &'a Scene,
    left_px: f64,
    /// Where labels are.
    labels_px: Vec<[f64; 2]>,
    svg: &'a mut String,
}

impl Panel<'_> {
    fn draw(&mut self) {
        let x = self.left_px;
        let heading = self.view.heading;
        self.push(&format!(
            "<text x=\"{x:.1}\" y=\"24\" font-size=\"15\" font-weight=\"bold\">{heading}</text>"
        ));
        self.grid();
        self.reach();
        let scene = self.scene;
        for [parent, child] in &scene.bones {
            self.line(parent, child, "#444444", 5.0, "stroke-linecap=\"round\"");
        }
        self.axes();
        for (ix, camera) in scene.cameras.iter().enumerate() {
            self.frustum(camera, CAMERA_COLORS[ix % CAMERA_COLORS.len()]);
        }
        for (name, origin) in &scene.scanners {
            self.dot(origin, "#666666");
            self.label(origin, name, "#666666");
        }
        self.dot(&scene.base, "black");
        self.label(&scene.base, "base", "black");
    }

    /// Lines at round distances, with their coordinates in meters.
    fn grid(&mut self) {
        let step_m = grid_step_m(self.scene.radius_m);
        let center = (self.view.project)(&self.scene.center);
        let radius_m = self.scene.radius_m;
        for axis in 0..2 {
            let first = ((center[axis] - radius_m) / step_m).ceil();
            let last = ((center[axis] + radius_m) / step_m).floor();
            let mut number = first;
            while number <= last {
                self.grid_line(axis, number * step_m);
                number += 1.0;
            }
        }
        let [horizontal, vertical] = self.view.axes;
        let [right, top] = [self.left_px + VIEW_PX, MARGIN_PX];
        let bottom = MARGIN_PX + VIEW_PX + 40.0;
        let left = self.left_px;
        self.push(&format!(
            "<text x=\"{right:.1}\" y=\"{bottom:.1}\" text-anchor=\"end\" fill=\"#666666\">{horizontal}, m</text>\n\
             <text x=\"{left:.1}\" y=\"{:.1}\" text-anchor=\"end\" fill=\"#666666\">{vertical}, m</text>",
            top - 8.0
        ));
    }

    fn grid_line(&mut self, axis: usize, at_m: f64) {
        let center = (self.view.project)(&self.scene.center);
        let radius_m = self.scene.radius_m;
        let end = |side: f64| {
            let mut point = center;
            point[axis] = at_m;
            point[1 - axis] += side * radius_m;
            point
        };
        let [[x1, y1], [x2, y2]] = [end(-1.0), end(1.0)].map(|point| self.at_plane(&point));
        let (x, y, anchor) = if axis == 0 {
            (x1, y1 + 16.0, "middle")
        } else {
            (x1 - 6.0, y1 + 4.0, "end")
        };
        // -0.0 would be printed with its sign.
        let number = at_m + 0.0;
        self.push(&format!(
            "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"#dddddd\"/>\n\
             <text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" fill=\"#666666\" font-size=\"10\">{number:.1}</text>"
        ));
    }

    /// The outline of the positions that the flange reaches.
    fn reach(&mut self) {
        let points: Vec<Point2<f64>> = self.scene.reached.iter().map(self.view.project).collect();
        if points.is_empty() {
            return;
        }
        let outline = self.path(&hull(points));
        self.push(&format!(
            "<polygon points=\"{outline}\" fill=\"#f2e6b8\" fill-opacity=\"0.5\" stroke=\"#b9a23c\"><title>positions that the flange reaches</title></polygon>"
        ));
    }

    /// The axes of the world and of the flange: x red, y green, z blue.
    fn axes(&mut self) {
        const COLORS: [&str; 3] = ["#d02020", "#108010", "#2040d0"];
        let world = [Vector3::x(), Vector3::y(), Vector3::z()];
        let length_m = AXIS_FRAC * self.scene.radius_m;
        for (origin, axes) in [(Point3::origin(), world)]
            .into_iter()
            .chain(self.scene.flange)
        {
            for (axis, color) in axes.iter().zip(COLORS) {
                self.line(&origin, &(origin + axis * length_m), color, 2.0, "");
            }
        }
        if let Some((origin, _)) = &self.scene.flange {
            self.label(origin, "flange", "black");
        }
    }

    fn frustum(&mut self, camera: &Frustum, color: &str) {
        let color = if camera.has_mistake { "#d00000" } else { color };
        if camera.corners.len() > 2 {
            let points = camera.corners.iter().chain([&camera.eye]);
            let outline = hull(points.map(self.view.project).collect());
            let outline = self.path(&outline);
            self.push(&format!(
                "<polygon points=\"{outline}\" fill=\"{color}\" fill-opacity=\"0.15\" stroke=\"{color}\" stroke-opacity=\"0.6\"/>"
            ));
        }
        self.line(
            &camera.eye,
            &camera.target,
            color,
            1.5,
            "stroke-dasharray=\"5 3\"",
        );
        self.dot(&camera.eye, color);
        self.label(&camera.eye, &camera.name, color);
    }

    fn line(
        &mut self,
        from: &Point3<f64>,
        to: &Point3<f64>,
        color: &str,
        width_px: f64,
        more: &str,
    ) {
        let [[x1, y1], [x2, y2]] = [from, to].map(|point| self.at(point));
        self.push(&format!(
            "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"{color}\" stroke-width=\"{width_px}\" {more}/>"
        ));
    }

    fn dot(&mut self, center: &Point3<f64>, color: &str) {
        let [x, y] = self.at(center);
        self.push(&format!(
            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{color}\"/>"
        ));
    }

    fn label(&mut self, at: &Point3<f64>, text: &str, color: &str) {
        let [x, y] = self.at(at);
        let [x, mut y] = [x + 7.0, y - 6.0];
        // Frames at the same place, such as base and flange from above, would hide each other's name.
        let covers = |y: f64| {
            let is_near = |[other_x, other_y]: &[f64; 2]| {
                (other_x - x).abs() < LABEL_PX[0] && (other_y - y).abs() < LABEL_PX[1]
            };
            self.labels_px.iter().any(is_near)
        };
        while covers(y) {
            y -= LABEL_PX[1];
        }
        self.labels_px.push([x, y]);
        let text = escaped(text);
        self.push(&format!(
            "<text x=\"{x:.1}\" y=\"{y:.1}\" fill=\"{color}\">{text}</text>"
        ));
    }

    fn path(&self, points: &[Point2<f64>]) -> String {
        let mut path = String::new();
        for point in points {
            let [x, y] = self.at_plane(point);
            write!(path, "{x:.1},{y:.1} ").expect("writing to a string does not fail");
        }
        path.trim_end().to_owned()
    }

    fn at(&self, point: &Point3<f64>) -> [f64; 2] {
        self.at_plane(&(self.view.project)(point))
    }

    /// Pixel of a point of the plane of the view.
    fn at_plane(&self, point: &Point2<f64>) -> [f64; 2] {
        let from_center = point - (self.view.project)(&self.scene.center);
        let px_per_m = 0.5 * VIEW_PX / self.scene.radius_m;
        let middle_px = 0.5 * VIEW_PX;
        [
            self.left_px + middle_px + px_per_m * from_center.x,
            MARGIN_PX + middle_px - px_per_m * from_center.y,
        ]
    }

    fn push(&mut self, element: &str) {
        self.svg.push_str(element);
        self.svg.push('\n');
    }
}

/// A round distance between grid lines, so that a view has 4 to 10 of them.
fn grid_step_m(radius_m: f64) -> f64 {
    let rough_m = 2.0 * radius_m / 8.0;
    let power = 10_f64.powf(rough_m.log10().floor());
    let steps = [1.0, 2.0, 5.0].map(|digit| digit * power);
    // Coordinates are printed with one decimal.
    let step_m = steps.into_iter().find(|step| *step >= rough_m);
    step_m.unwrap_or(10.0 * power).max(0.1)
}

/// The convex hull, counterclockwise (A. M. Andrew, "Another efficient algorithm for convex hulls in
/// two dimensions", 1979).
fn hull(mut points: Vec<Point2<f64>>) -> Vec<Point2<f64>> {
    points.sort_by(|one, other| one.x.total_cmp(&other.x).then(one.y.total_cmp(&other.y)));
    let half = |points: &mut dyn Iterator<Item = Point2<f64>>| {
        let mut chain: Vec<Point2<f64>> = Vec::new();
        for point in points {
            while let [.., before, last] = chain[..]
                && (last - before).perp(&(point - before)) <= 0.0
            {
                chain.pop();
            }
            chain.push(point);
        }
        // The last point is the first one of the other half.
        chain.pop();
        chain
    };
    let mut hull = half(&mut points.iter().copied());
    hull.extend(half(&mut points.iter().rev().copied()));
    hull
}

/// Text in XML.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
}

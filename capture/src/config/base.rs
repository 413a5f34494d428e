//! The keys in `[base]`, and the tags that locate a base.

use super::base_motion::BaseMotion;
use super::key::{Keys, choices, entry, keys, table_of};
use super::section::Section;
use super::table_schema::TableSchema;
use drivers::tags::{Family, TagPlacement};
use kinematics::Transform;
use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use toml::{Table, Value};

/// Default address for base poses. It accepts data from this computer only.
const DEFAULT_ADDRESS: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 7009);

keys! {
    /// Pose of the base and its source.
    #[derive(Clone, Debug, PartialEq)]
    pub struct Base {
        /// Source of the base pose.
        pub driver: BaseDriver = BaseDriver::Fixed;
        /// Address on which the driver `udp` receives base poses.
        pub address: SocketAddr = DEFAULT_ADDRESS;
        /// Pose of a fixed base; the identity in simulation.
        pub world_from_base: Transform = Transform::identity();
        /// Pose rate of a simulated base, Hz.
        pub rate_hz: f64 = 100.0, in 1.0..=1000.0;
        /// Whether the pose is re-estimated at each station.
        pub realign: bool = true;
        /// Maximum root mean square position error of a measured pose, meters. Poses with a larger
        /// error are discarded.
        pub max_sigma_m: f64 = 0.05, in 0.0001..=100.0;
        /// Maximum root mean square orientation error of a measured pose, radians. Poses with a
        /// larger error are discarded.
        pub max_sigma_rad: f64 = 0.03, in 0.0001..=3.2;
        /// Family of the AprilTags.
        pub tag_family: Family = Family::Tag36h11;
        /// Sizes and poses of the tags in the world, by ID.
        pub tags: BTreeMap<u32, TagPlacement> => BTreeMap::new();
        /// How an operator may drive the base.
        pub motion: Option<BaseMotion>;
        /// Errors of a simulated base.
        pub sim: BaseSim;
    }

    /// Errors of a simulated base.
    #[derive(Clone, Debug, PartialEq)]
    pub struct BaseSim {
        /// Position error at the end of the path of the base, root mean square, meters.
        pub drift_m: f64 = 0.02, in 0.0..=10.0;
        /// Orientation error at the end of the path of the base, root mean square, radians.
        pub drift_rad: f64 = 0.0175, in 0.0..=1.0;
    }

    /// The keys in `[base.tag.ID]`.
    struct TagKeys {
        /// Side length of the tag's border, where black meets white, meters.
        size_m: f64, in 0.001..=10.0, required "side length of the tag's border, where black meets white, m";
        /// Pose of the tag: x to the right of the print, y down, z into it.
        world_from_tag: Transform = Transform::identity();
    }
}

/// Source of the base pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BaseDriver {
    /// The base does not move.
    Fixed,
    /// AprilTags in the images of cameras on the base or arm.
    Tags,
    /// Reserved for estimating the pose from color and depth images. This version cannot open it.
    Rgbd,
    /// Datagrams from another program.
    Udp,
    /// The simulator.
    Sim,
}

choices! {
    BaseDriver { Fixed = "fixed", Tags = "tags", Rgbd = "rgbd", Udp = "udp", Sim = "sim" }
    Family {
        Tag36h11 = "tag36h11", Tag25h9 = "tag25h9", Tag16h5 = "tag16h5", Standard41h12 = "tagStandard41h12",
        Standard52h13 = "tagStandard52h13"
    }
}

/// Schema of the table.
pub(super) fn schema() -> TableSchema {
    let mut base = table_of::<Base>();
    let about =
        "AprilTags at known places. The name of a table is the ID of its tag: [base.tag.7].";
    base.named("tag", about, "^[0-9]+$", table_of::<TagKeys>());
    base
}

pub(super) fn read(mut keys: Section<'_>) -> Option<Base> {
    let mut base = Base::read_keys(&mut keys)?;
    let tags = keys
        .named_sections("tag")
        .into_iter()
        .filter_map(|(id, keys)| tag(&id, base.tag_family, keys));
    base.tags = tags.collect();
    if base.driver == BaseDriver::Tags && base.tags.is_empty() {
        keys.missing(
            "tag",
            "a table [base.tag.ID] for each tag, with size_m and world_from_tag",
        );
    }
    keys.end();
    Some(base)
}

/// Reads a tag and its ID. Reports an invalid value and returns `None`.
fn tag(id: &str, family: Family, keys: Section<'_>) -> Option<(u32, TagPlacement)> {
    // The comparison with the text rejects other spellings of a number, such as `+1` or `007`,
    // which would allow two tables for one tag.
    let number = id
        .parse()
        .ok()
        .filter(|number: &u32| number.to_string() == id && *number < family.n_tags());
    let allowed = format!(
        "ID of a tag in its family, 0 to {}, as the name of the table",
        family.n_tags() - 1
    );
    let id = number.or_else(|| keys.invalid("id", &Value::from(id), &allowed));
    let TagKeys {
        size_m,
        world_from_tag,
    } = keys.read()?;
    Some((
        id?,
        TagPlacement {
            size_m,
            world_from_tag,
        },
    ))
}

/// The table of one tag, with its ID as the name.
fn tag_entry((id, tag): (&u32, &TagPlacement)) -> Option<(String, Value)> {
    let TagPlacement {
        size_m,
        world_from_tag,
    } = *tag;
    entry(
        &id.to_string(),
        &TagKeys {
            size_m,
            world_from_tag,
        },
    )
}

pub(super) fn write(base: &Base) -> Table {
    let mut table = base.write_keys();
    if !base.tags.is_empty() {
        table.insert(
            "tag".to_owned(),
            Value::Table(base.tags.iter().filter_map(tag_entry).collect()),
        );
    }
    table
}

//! The keys in `[range.NAME]`.

use super::key::{Keys, choices, keys, table_of};
use super::section::Section;
use super::table_schema::TableSchema;
use kinematics::Transform;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;

/// Default address for range scans. It accepts data from this computer only.
const DEFAULT_ADDRESS: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 7010);

keys! {
    /// A range scanner that rotates about its z axis.
    #[derive(Clone, Debug, PartialEq)]
    pub struct Scanner {
        /// Name of its table in the rig file: letters, digits, `_` and `-`.
        pub name: Arc<str> => "".into();
        /// Source of the scans.
        pub driver: ScannerDriver, required "udp or sim";
        /// Address on which the driver `udp` receives scans.
        pub address: SocketAddr = DEFAULT_ADDRESS;
        /// Rotations per second.
        pub rate_hz: f64 = 10.0, in 0.1..=50.0;
        /// Pose on the base: x forward, z up.
        pub base_from_scanner: Transform = Transform::identity();
        /// Shorter ranges are discarded, meters.
        pub min_m: f64 = 0.4, in 0.0..=100.0;
        /// Longer ranges are discarded, meters.
        pub max_m: f64 = min_m.max(50.0), in min_m..=1000.0, within 0.0..=1000.0;
        /// Scan pattern and errors in simulation.
        pub sim: ScannerSim;
    }

    /// Scan pattern and errors of a simulated scanner.
    #[derive(Clone, Debug, PartialEq)]
    pub struct ScannerSim {
        /// Number of rings, evenly spaced in elevation.
        pub rings: u32 = 16, in 1..=256;
        /// Directions per ring and scan.
        pub columns: u32 = 900, in 4..=4096;
        /// Elevation of the lowest ring, radians.
        pub min_elevation_rad: f64 = -0.2618, in -1.57..=1.57;
        /// Elevation of the highest ring, radians.
        pub max_elevation_rad: f64 = min_elevation_rad.max(0.2618), in min_elevation_rad..=1.57, within -1.57..=1.57;
        /// Standard deviation of the range, meters.
        pub noise_sigma_m: f64 = 0.02, in 0.0..=1.0;
        /// Fraction of returns that are lost.
        pub dropped_frac: f64 = 0.01, in 0.0..=0.9;
    }
}

/// Source of range scans.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScannerDriver {
    /// Datagrams from another program.
    Udp,
    /// The simulator.
    Sim,
}

choices! {
    ScannerDriver { Udp = "udp", Sim = "sim" }
}

/// Schema of the table of a scanner.
pub(super) fn schema() -> TableSchema {
    table_of::<Scanner>()
}

pub(super) fn read(name: &str, mut keys: Section<'_>) -> Option<Scanner> {
    keys.check_name(name);
    let scanner = Scanner::read_keys(&mut keys);
    keys.end();
    Some(Scanner {
        name: name.into(),
        ..scanner?
    })
}

//! Numbers of the endpoints that configure the watchdog of an axis. The numbers depend on the
//! firmware; ODrive publishes a file for each version.
//!
//! Source: ODrive CAN protocol page, "Arbitrary parameter access"; `odriverobotics/ODriveResources`
//! `can_restore_config.py`, which compares `fw_version` and `hw_version` of `flat_endpoints.json`
//! with the versions that the axis reports (`Get_Version`) before it writes anything.

use serde::Deserialize;
use std::collections::BTreeMap;

/// The endpoints of a firmware's `flat_endpoints.json` that are needed to move an axis.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Endpoints {
    /// Firmware version, for instance "0.6.10".
    pub firmware: String,
    /// Hardware version: product line, version and variant.
    pub hardware: String,
    /// Endpoint of the watchdog timeout in seconds, a float.
    pub watchdog_timeout: u16,
    /// Endpoint that enables the watchdog, one byte.
    pub enable_watchdog: u16,
}

/// The text is not a valid `flat_endpoints.json`.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EndpointsError {
    /// The text is not JSON of the expected form.
    #[error("not a flat_endpoints.json of ODrive: {0}")]
    Malformed(#[from] serde_json::Error),
    /// An endpoint is missing, or has another type.
    #[error("endpoint {name:?} of type {kind} is missing")]
    Missing {
        /// Path of the endpoint.
        name: &'static str,
        /// Its type.
        kind: &'static str,
    },
}

#[derive(Deserialize)]
struct Flat {
    fw_version: String,
    hw_version: String,
    endpoints: BTreeMap<String, Endpoint>,
}

#[derive(Deserialize)]
struct Endpoint {
    id: u16,
    #[serde(rename = "type")]
    kind: String,
}

impl Flat {
    /// Number of the endpoint with this path and type.
    fn number(&self, name: &'static str, kind: &'static str) -> Result<u16, EndpointsError> {
        // The type determines how the bytes of a value are encoded. With another one, the timeout
        // would be written as a different number.
        let found = self
            .endpoints
            .get(name)
            .filter(|endpoint| endpoint.kind == kind);
        found
            .map(|endpoint| endpoint.id)
            .ok_or(EndpointsError::Missing { name, kind })
    }
}

impl Endpoints {
    /// Parses the text of a `flat_endpoints.json`.
    pub fn parse(text: &str) -> Result<Self, EndpointsError> {
        let flat: Flat = serde_json::from_str(text)?;
        let watchdog_timeout = flat.number("axis0.config.watchdog_timeout", "float")?;
        let enable_watchdog = flat.number("axis0.config.enable_watchdog", "bool")?;
        Ok(Self {
            firmware: flat.fw_version,
            hardware: flat.hw_version,
            watchdog_timeout,
            enable_watchdog,
        })
    }

    /// Whether the endpoints are valid for an axis that reports these versions.
    pub fn match_versions(&self, hardware: [u8; 3], firmware: [u8; 3]) -> bool {
        let dotted = |version: [u8; 3]| version.map(|part| part.to_string()).join(".");
        self.firmware == dotted(firmware) && self.hardware == dotted(hardware)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = r#"{"fw_version": "0.6.9", "hw_version": "4.4.58", "endpoints": {
        "vbus_voltage": {"id": 1, "type": "float", "access": "r"},
        "axis0.watchdog_feed": {"id": 190, "type": "function", "inputs": [], "outputs": []},
        "axis0.config.watchdog_timeout": {"id": 218, "type": "float", "access": "rw"},
        "axis0.config.enable_watchdog": {"id": 219, "type": "bool", "access": "rw"}}}"#;

    #[test]
    fn watchdog_endpoints_are_found_in_manufacturer_file() {
        let endpoints = Endpoints::parse(TEXT).expect("a file");
        assert_eq!(
            (endpoints.watchdog_timeout, endpoints.enable_watchdog),
            (218, 219)
        );
        assert!(endpoints.match_versions([4, 4, 58], [0, 6, 9]));
        assert!(
            !endpoints.match_versions([4, 4, 58], [0, 6, 10])
                && !endpoints.match_versions([4, 4, 57], [0, 6, 9])
        );
    }

    #[test]
    fn other_files_are_rejected() {
        assert!(matches!(
            Endpoints::parse("[]"),
            Err(EndpointsError::Malformed(_))
        ));
        assert!(matches!(
            Endpoints::parse(&TEXT[..60]),
            Err(EndpointsError::Malformed(_))
        ));
        let renamed = TEXT.replace("config.enable_watchdog", "config.watch");
        assert!(
            Endpoints::parse(&renamed)
                .expect_err("no watchdog")
                .to_string()
                .contains("enable_watchdog")
        );
        let wrong_type = TEXT.replace("\"bool\"", "\"uint32\"");
        assert!(matches!(
            Endpoints::parse(&wrong_type),
            Err(EndpointsError::Missing { kind: "bool", .. })
        ));
    }
}

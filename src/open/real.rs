//! The devices of a rig that are not simulated.

use crate::config::{BaseDriver, Rig, ScannerDriver};
use drivers::udp::{UdpBase, UdpScanner};
use drivers::{Base, Devices, Error, RangeScanner};

/// Opens them; a rig may have none.
pub(super) fn open(rig: &Rig) -> Result<Devices, Error> {
    let mut devices = Devices::default();
    if rig.base.driver == BaseDriver::Udp {
        let base = UdpBase::open(rig.base.address)?;
        log::info!("base: listening on {}", base.address());
        devices.base = Some(Box::new(base) as Box<dyn Base>);
    }
    for scanner in rig.scanners.iter().filter(|scanner| scanner.driver == ScannerDriver::Udp) {
        let open = UdpScanner::open(&scanner.name, scanner.address)?;
        log::info!("range scanner {:?}: listening on {}", scanner.name, open.address());
        devices.scanners.push(Box::new(open) as Box<dyn RangeScanner>);
    }
    Ok(devices)
}

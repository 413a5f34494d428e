//! Only one process at a time may move the arm on a bus or controller.

use crate::Error;
use rustix::net::sockopt::socket_peercred;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener, UnixStream};

/// The exclusive right of this process to move the arms on a bus or controller. The kernel releases
/// the lock when the process ends, even if the process is killed.
///
/// The lock is a Unix socket with an abstract name. Unlike a file, it needs no folder that all
/// users may write to. It also belongs to the same network namespace as a CAN interface.
#[derive(Debug)]
pub(crate) struct MotionLock {
    _listener: UnixListener,
}

impl MotionLock {
    /// Takes the lock of an interface or a controller's address.
    ///
    /// # Errors
    /// If another program holds it.
    pub(crate) fn take(name: &str) -> Result<Self, Error> {
        let fail = |error: std::io::Error| Error::Motion {
            reason: format!("cannot lock {name}: {error}"),
        };
        // All programs of a network namespace share the abstract names. The prefix distinguishes
        // this name from the names of other programs.
        let address =
            SocketAddr::from_abstract_name(format!("fieldrig-move/{name}")).map_err(fail)?;
        match UnixListener::bind_addr(&address) {
            Ok(listener) => Ok(Self {
                _listener: listener,
            }),
            Err(error) if error.kind() == std::io::ErrorKind::AddrInUse => {
                // A connection to the socket shows which process holds the lock, because the kernel
                // reports the process that listens. The other process may end at the same time, so
                // its number is optional.
                let owner = UnixStream::connect_addr(&address)
                    .ok()
                    .and_then(|stream| socket_peercred(stream).ok());
                let owner =
                    owner.map_or(String::new(), |owner| format!(" (process {})", owner.pid));
                Err(Error::Motion {
                    reason: format!("another program{owner} moves the arm on {name}; end it first"),
                })
            }
            Err(error) => Err(fail(error)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lock_is_free_again_after_its_owner() {
        let name = format!("test{}", std::process::id());
        let lock = MotionLock::take(&name).expect("nobody else uses this name");
        let refusal = MotionLock::take(&name)
            .expect_err("it is taken")
            .to_string();
        assert!(
            refusal.contains(&format!("process {}", std::process::id())) && refusal.contains(&name),
            "{refusal}"
        );
        MotionLock::take(&format!("{name}b")).expect("another bus is free");
        drop(lock);
        MotionLock::take(&name).expect("it is free again");
    }
}

//! Checks whether the page can be served.

use capture::doctor::Finding;
use messages::Setting;
use std::net::TcpListener;

/// Whether the page can be served at an address.
#[must_use]
pub fn page_finding(address: &str) -> Finding {
    match TcpListener::bind(address) {
        Ok(_) => Finding::ok("network", format!("{address} is free for the page")),
        Err(error) => Finding::warn(
            "network",
            format!("{address}: {error}"),
            format!(
                "choose another address: fieldrig run ... {} 127.0.0.1:7008",
                Setting::Listen
            ),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use capture::doctor::Verdict;

    #[test]
    fn occupied_port_is_reported() {
        let occupied = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = occupied.local_addr().expect("bound").to_string();
        assert_eq!(page_finding(&address).verdict, Verdict::Warn);
        drop(occupied);
        assert_eq!(page_finding(&address).verdict, Verdict::Ok);
    }
}

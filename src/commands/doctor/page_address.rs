//! Checks the address of the page.

use capture::doctor::Finding;
use std::net::TcpListener;

/// Whether the page can be served at an address.
pub(super) fn page_address(address: &str) -> Finding {
    match TcpListener::bind(address) {
        Ok(_) => Finding::ok("network", format!("{address} is free for the page")),
        Err(error) => {
            let remedy = "choose another address: fieldrig run ... --listen 127.0.0.1:7008";
            Finding::warn("network", format!("{address}: {error}"), remedy)
        }
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
        assert_eq!(page_address(&address).verdict, Verdict::Warn);
        drop(occupied);
        assert_eq!(page_address(&address).verdict, Verdict::Ok);
    }
}

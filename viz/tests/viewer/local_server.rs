//! Servers on a free port of this computer.

use viz::{Hub, Server, ServerConfig};

/// A hub, and a server of its data.
pub(crate) fn start() -> (Hub, Server) {
    let hub = Hub::new();
    let server = serve(&hub);
    (hub, server)
}

/// A server of a hub's data.
pub(crate) fn serve(hub: &Hub) -> Server {
    let config = ServerConfig {
        listen: ([127, 0, 0, 1], 0).into(),
    };
    Server::start(config, hub.clone()).expect("a free port exists")
}

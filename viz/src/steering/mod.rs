//! The WebSocket `/steer`: passes requests of operators to the thread that decides what the arm
//! does, and the state of the arm to all clients.
//!
//! It does not decide whether the arm moves. It refuses what no decision needs: messages that cannot
//! be read, roles that may not steer, and floods.

pub(crate) mod arm_description;
pub(crate) mod client_message;
mod inbox;
#[cfg(any(test, fuzzing))]
pub(crate) mod message_checks;
mod message_rate;
mod outbox;
pub(crate) mod preview;
pub(crate) mod request;
mod server_message;
pub(crate) mod socket;
pub(crate) mod state;
pub(crate) mod steering_server;
pub(crate) mod steering_thread;

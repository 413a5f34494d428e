//! The WebSocket `/steer`: passes requests of operators to the thread that decides what the arm
//! does, and the state of the arm to all clients.
//!
//! It does not decide whether the arm moves. It refuses what no decision needs: messages that cannot
//! be read, roles that may not steer, and floods.

pub(crate) mod arm_description;
mod inbox;
mod outbox;
pub(crate) mod preview;
pub(crate) mod request;
pub(crate) mod state;
pub(crate) mod steering_server;

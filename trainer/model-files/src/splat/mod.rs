//! Files of splats, and the arrays that they hold.

pub mod antimatter15;
pub mod arrays;
pub mod cloud;
pub mod file;
pub mod ply;
pub mod spz;

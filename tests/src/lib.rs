//! What the tests share: golden data, scratch clips, the device, and the program as a child process.

pub mod clips;
pub mod golden;
pub mod gpu;
pub mod program;

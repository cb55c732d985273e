//! What the tests share: golden data, scratch clips, and the program as a child process.

pub mod clips;
pub mod golden;
pub mod program;

//! What the tests share: golden data and scratch clips.

pub mod golden;

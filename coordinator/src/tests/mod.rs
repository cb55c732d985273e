//! The coordinator over loopback, with workers that speak the protocol by hand.

mod early_tracks;
mod handover;
mod harness;
mod jobs;
mod learned;
mod leases;
mod own_tracks;
mod ownership;
mod remote_clips;
mod reports;
mod restart;
mod runs;
mod states;
mod track_files;
mod tracks;
mod transfers;
mod windows;

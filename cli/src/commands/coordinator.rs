//! `coordinator`: serves jobs to workers and clients.

use std::{net::SocketAddr, path::PathBuf, time::Duration};

use clap::Args;
use trackersplat_coordinator::{ServeOptions, serve};

use super::cores;
use crate::{environment, error::CliError, interrupt, stdout};

/// Longest duration that may be given.
const LONGEST_SECONDS: f64 = 86_400.0;

/// Arguments of `coordinator`.
#[derive(Args, Debug)]
pub(crate) struct CoordinatorArgs {
    /// Folder of its state; the same folder goes on where it was.
    #[arg(long, value_name = "DIR")]
    root: PathBuf,

    /// Where to listen; port 0 lets the system choose.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:7700")]
    listen: SocketAddr,

    /// Threads for static models and tracks [default: one per core].
    #[arg(long, value_name = "N")]
    compute_threads: Option<usize>,

    /// Seconds between a worker's heartbeats.
    #[arg(long, value_name = "SECONDS", default_value = "1", value_parser = seconds, help_heading = "Leases")]
    heartbeat_interval: Duration,

    /// Seconds without a heartbeat after which a lease expires.
    #[arg(long, value_name = "SECONDS", default_value = "10", value_parser = seconds, help_heading = "Leases")]
    lease_duration: Duration,

    /// Seconds that a lease waits for its worker to come back after the connection broke [default: 3, at most
    /// --lease-duration].
    #[arg(long, value_name = "SECONDS", value_parser = seconds, help_heading = "Leases")]
    reconnect_grace: Option<Duration>,

    /// Failed attempts that a frame, or the tracks of a view, may have.
    #[arg(long, value_name = "N", default_value_t = 3, help_heading = "Leases")]
    max_attempts: u32,

    #[command(flatten)]
    engine: crate::args::EngineArgs,
}

pub(super) async fn run(args: CoordinatorArgs) -> Result<(), CliError> {
    let interrupted = interrupt::token()?;
    let defaults = ServeOptions::default();
    let reconnect_grace = args.reconnect_grace.unwrap_or(defaults.reconnect_grace.min(args.lease_duration));
    let options = ServeOptions {
        root: args.root,
        listen: args.listen,
        compute_threads: args.compute_threads.unwrap_or_else(cores),
        heartbeat_interval: args.heartbeat_interval,
        lease_duration: args.lease_duration,
        reconnect_grace,
        max_attempts: args.max_attempts,
        stores: environment::stores(),
        ..defaults
    };
    let running = serve(options, args.engine.engine()?, interrupted).await?;
    // For scripts that let the system choose the port.
    stdout::line(format_args!("http://{}", running.address));
    Ok(running.finished().await?)
}

/// A number of seconds, with fractions, of a day at most: what is added to a clock must not overflow it.
pub(super) fn seconds(text: &str) -> Result<Duration, String> {
    let seconds: f64 = text.parse().map_err(|_| format!("'{text}' is no number of seconds"))?;
    if seconds > LONGEST_SECONDS {
        return Err(format!("'{text}' seconds are longer than a day; give {LONGEST_SECONDS} at most"));
    }
    Duration::try_from_secs_f64(seconds).map_err(|error| format!("'{text}' seconds: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seconds_have_fractions_and_are_not_negative() {
        assert_eq!(seconds("0.5"), Ok(Duration::from_millis(500)));
        assert_eq!(seconds("86400"), Ok(Duration::from_secs(86_400)));
        for wrong in ["", "x", "-1", "NaN", "inf", "1e300", "1e19", "86401"] {
            assert!(seconds(wrong).is_err(), "{wrong}");
        }
    }
}

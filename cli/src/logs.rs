//! Logs go to standard error; results to standard output.

use std::io::IsTerminal;

use clap::{ArgAction, Args};
use tracing_subscriber::{EnvFilter, filter::LevelFilter};

/// How much to say, and how.
#[derive(Args, Clone, Debug)]
pub(crate) struct LogArgs {
    /// Say more; twice: everything.
    #[arg(short, long, action = ArgAction::Count, global = true, conflicts_with = "quiet", help_heading = "Logs")]
    pub(crate) verbose: u8,

    /// Say errors only, and draw no progress.
    #[arg(short, long, global = true, help_heading = "Logs")]
    pub(crate) quiet: bool,

    /// Logs as JSON, one object per line.
    #[arg(long, global = true, help_heading = "Logs")]
    pub(crate) log_json: bool,
}

/// Starts logging. `RUST_LOG` overrules the flags.
///
/// A command that watches its own embedded coordinator hears every change twice; of the coordinator it then says
/// warnings only, and how far it is with copying a clip: nothing else is to be seen before that ends.
pub(crate) fn start(args: &LogArgs, watches_own_coordinator: bool) {
    let level = level(args);
    let coordinator =
        if watches_own_coordinator && args.verbose == 0 { level.min(LevelFilter::WARN) } else { level };
    let copying = if args.quiet { level } else { level.max(LevelFilter::INFO) };
    let default = format!(
        "{level},trackersplat_coordinator={coordinator},trackersplat_coordinator::remote_clip={copying}"
    );
    let wanted = std::env::var(EnvFilter::DEFAULT_ENV).unwrap_or(default);
    let filter = EnvFilter::builder().parse_lossy(wanted);
    let logs = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    if args.log_json {
        logs.json().init();
    } else {
        logs.with_target(false).with_ansi(std::io::stderr().is_terminal()).init();
    }
}

/// Progress bars take the place of the ordinary lines on a terminal.
fn level(args: &LogArgs) -> LevelFilter {
    match args.verbose {
        _ if args.quiet => LevelFilter::ERROR,
        0 if std::io::stderr().is_terminal() && !args.log_json => LevelFilter::WARN,
        0 => LevelFilter::INFO,
        1 => LevelFilter::DEBUG,
        _ => LevelFilter::TRACE,
    }
}

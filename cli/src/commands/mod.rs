//! The commands, one file each.

mod cancel;
mod coordinator;
mod demo;
mod devices;
mod eval;
mod eval_tracks;
mod fetch;
mod inspect;
mod list;
mod reconstruct;
mod render;
mod submit;
mod track;
mod watch;
mod worker;

use clap::{Parser, Subcommand};
use tokio_util::sync::CancellationToken;

use crate::{
    error::{CliError, EXIT_CODES},
    interrupt,
    logs::LogArgs,
    stdout,
};

/// Moving 3D Gaussians from synchronized multi-view video.
#[derive(Debug, Parser)]
#[command(name = "trackersplat", version, after_help = EXIT_CODES, propagate_version = true)]
pub(crate) struct Cli {
    #[command(subcommand)]
    pub(crate) command: Command,

    #[command(flatten)]
    pub(crate) logs: LogArgs,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Reconstruct a clip on this machine: coordinator and workers in one command.
    #[command(after_help = EXIT_CODES)]
    Reconstruct(reconstruct::ReconstructArgs),
    /// Reconstruct the bundled clip.
    Demo(demo::DemoArgs),
    /// Measure a result against its clip's held-out views again.
    Eval(eval::EvalArgs),
    /// Render a frame of a result from one of its views.
    Render(render::RenderArgs),
    /// Track every pixel of the key frame through a clip, and write the tracks.
    #[command(after_help = EXIT_CODES)]
    Track(track::TrackArgs),
    /// Measure tracks against the exact flow of a rendered clip.
    #[command(after_help = EXIT_CODES)]
    EvalTracks(eval_tracks::EvalTracksArgs),
    /// Say what is in a Gaussian file.
    Inspect(inspect::InspectArgs),
    /// List the devices that a worker can use.
    Devices(devices::DevicesArgs),
    /// Serve jobs to workers and clients until interrupted.
    Coordinator(coordinator::CoordinatorArgs),
    /// Work for a coordinator until dismissed or interrupted.
    Worker(worker::WorkerArgs),
    /// Submit a clip to a coordinator.
    Submit(submit::SubmitArgs),
    /// Watch a job until it ends.
    Watch(watch::WatchArgs),
    /// List a coordinator's jobs.
    List(list::ListArgs),
    /// Cancel a job; its finished frames stay.
    Cancel(cancel::CancelArgs),
    /// Fetch a job's results.
    Fetch(fetch::FetchArgs),
}

impl Command {
    /// Whether the command runs a coordinator of its own and watches it.
    pub(crate) fn embeds_coordinator(&self) -> bool {
        matches!(self, Self::Reconstruct(_) | Self::Demo(_))
    }
}

/// Runs a command to its end.
pub(crate) fn run(cli: Cli) -> Result<(), CliError> {
    let Cli { command, logs } = cli;
    match command {
        Command::Eval(args) => eval::run(args),
        Command::Render(args) => render::run(args),
        Command::Track(args) => track::run(args, &logs),
        Command::EvalTracks(args) => eval_tracks::run(args, &logs),
        Command::Inspect(args) => inspect::run(args),
        Command::Devices(args) => devices::run(args),
        Command::Reconstruct(args) => wait(reconstruct::run(args, &logs)),
        Command::Demo(args) => wait(demo::run(args, &logs)),
        Command::Coordinator(args) => wait(coordinator::run(args)),
        Command::Worker(args) => wait(worker::run(args)),
        Command::Submit(args) => wait(submit::run(args)),
        Command::Watch(args) => wait(watch::run(args, &logs)),
        Command::List(args) => wait(list::run(args)),
        Command::Cancel(args) => wait(cancel::run(args)),
        Command::Fetch(args) => wait(fetch::run(args)),
    }
}

/// Runs an asynchronous command. Threads that still compute when it ends are left behind, not waited for.
fn wait(command: impl Future<Output = Result<(), CliError>>) -> Result<(), CliError> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|error| CliError::failed("cannot start the runtime", error))?;
    let ended = runtime.block_on(command);
    runtime.shutdown_background();
    ended
}

/// Runs a computation that looks between its steps whether it is interrupted, so that it can clear up.
fn compute(
    work: impl FnOnce(CancellationToken) -> Result<(), CliError> + Send + 'static,
) -> Result<(), CliError> {
    wait(async {
        let interrupted = interrupt::token()?;
        let ended = tokio::task::spawn_blocking(|| work(interrupted)).await;
        ended.map_err(|error| CliError::failed("the computation broke off", error))?
    })
}

/// Prints a value for scripts.
fn print_json(value: &impl serde::Serialize) -> Result<(), CliError> {
    let json = serde_json::to_string_pretty(value).map_err(|error| CliError::failed("JSON", error))?;
    stdout::line(&json);
    Ok(())
}

/// Cores of this machine.
fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn the_line_of_the_readme_is_understood() {
        let line = "trackersplat reconstruct clip --out dir --workers 2 --frames 1..10 --test-views a,b \
                    --quality draft --static-model s.ply --tracks exact --motion none --seed 7 --json -v";
        let cli = Cli::try_parse_from(line.split_whitespace());
        assert!(matches!(cli.map(|cli| cli.command), Ok(Command::Reconstruct(_))));
    }

    #[test]
    fn wrong_usage_is_exit_code_2() {
        for line in [
            "trackersplat",
            "trackersplat reconstruct",
            "trackersplat reconstruct clip --out d --frames 5..1",
            "trackersplat reconstruct clip --out d --quality perfect",
            "trackersplat eval d -v -q",
        ] {
            let error = Cli::try_parse_from(line.split_whitespace()).err().map(|error| error.exit_code());
            assert_eq!(error, Some(2), "{line}");
        }
    }
}

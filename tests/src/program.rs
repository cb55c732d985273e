//! The `trackersplat` program as a child process whose log lines can be waited for.

use std::{
    ffi::OsStr,
    io::{BufRead, BufReader},
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Stdio},
    sync::{Arc, Mutex, OnceLock},
    time::{Duration, Instant},
};

/// Longer than anything a healthy run does; a hung run fails with its log instead of hanging the gate.
const PATIENCE: Duration = Duration::from_secs(180);

/// Path of the program: what `TRACKERSPLAT_PROGRAM` names, else built once with the profile of the tests.
///
/// # Panics
/// If the program cannot be built.
pub fn path() -> &'static Path {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    PROGRAM.get_or_init(|| {
        if let Some(built) = std::env::var_os("TRACKERSPLAT_PROGRAM") {
            return built.into();
        }
        let test = std::env::current_exe().expect("a test knows its own file");
        let folder = test.ancestors().nth(2).expect("tests lie in <profile>/deps");
        let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
        let mut build = Command::new(cargo);
        without_package(&mut build);
        build.args(["build", "--quiet", "--package", "trackersplat"]).current_dir(workspace());
        if folder.ends_with("release") {
            build.arg("--release");
        }
        assert!(build.status().expect("cargo runs").success(), "the program builds");
        folder.join(format!("trackersplat{}", std::env::consts::EXE_SUFFIX))
    })
}

/// Takes away what cargo tells a test of its package: build scripts that watch these variables would run again, and what
/// depends on them would be built again.
fn without_package(command: &mut Command) {
    for (name, _) in std::env::vars_os() {
        let text = name.to_string_lossy();
        if text.starts_with("CARGO_PKG_") || text.starts_with("CARGO_MANIFEST_") {
            command.env_remove(&name);
        }
    }
}

/// Root of the workspace.
pub fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("a member lies in the workspace").to_owned()
}

/// The bundled clip.
pub fn demo_clip() -> PathBuf {
    workspace().join("assets/demo-clip")
}

/// A running program; killed when dropped.
pub struct Running {
    child: Child,
    lines: Arc<Mutex<Vec<String>>>,
}

/// Starts the program with `arguments`.
///
/// # Panics
/// If it cannot be started.
pub fn start<A: AsRef<OsStr>>(arguments: impl IntoIterator<Item = A>) -> Running {
    let mut child = Command::new(path())
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    let lines = Arc::new(Mutex::new(Vec::new()));
    collect(child.stdout.take().expect("stdout is piped"), lines.clone());
    collect(child.stderr.take().expect("stderr is piped"), lines.clone());
    Running { child, lines }
}

/// Runs the program to its end: exit code, and everything it said.
pub fn run<A: AsRef<OsStr>>(arguments: impl IntoIterator<Item = A>) -> (i32, String) {
    let mut running = start(arguments);
    let status = running.wait();
    (status.code().unwrap_or(-1), running.log())
}

fn collect(from: impl std::io::Read + Send + 'static, into: Arc<Mutex<Vec<String>>>) {
    std::thread::spawn(move || {
        for line in BufReader::new(from).lines().map_while(Result::ok) {
            into.lock().expect("no reader panics").push(line);
        }
    });
}

impl Running {
    /// Process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Whether it has not ended.
    ///
    /// # Panics
    /// If the process cannot be asked.
    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().expect("a child can be asked").is_none()
    }

    /// Everything said so far.
    pub fn log(&self) -> String {
        self.lines.lock().expect("no reader panics").join("\n")
    }

    /// Waits until a line holds all of `parts`, and returns it.
    ///
    /// # Panics
    /// If the program ends, or stays silent for longer than any healthy run, before it says so.
    pub fn wait_for(&mut self, parts: &[&str]) -> String {
        let start = Instant::now();
        loop {
            let found = self
                .lines
                .lock()
                .expect("no reader panics")
                .iter()
                .find(|line| parts.iter().all(|part| line.contains(part)))
                .cloned();
            if let Some(line) = found {
                return line;
            }
            assert!(self.is_running() && start.elapsed() < PATIENCE, "never said {parts:?}:\n{}", self.log());
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Waits for the end.
    ///
    /// # Panics
    /// If it takes longer than any healthy run.
    pub fn wait(&mut self) -> ExitStatus {
        let start = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().expect("a child can be asked") {
                // The readers see the end of the pipes at about the same time.
                std::thread::sleep(Duration::from_millis(100));
                return status;
            }
            assert!(start.elapsed() < PATIENCE, "never ended:\n{}", self.log());
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// SIGKILL.
    ///
    /// # Panics
    /// If the process cannot be killed.
    pub fn kill(&mut self) {
        self.child.kill().expect("a child can be killed");
        self.child.wait().expect("a killed child ends");
    }

    /// Process ids of the children, on Linux.
    ///
    /// # Panics
    /// If /proc cannot be read.
    pub fn children(&self) -> Vec<i32> {
        let mut children = Vec::new();
        let tasks = std::fs::read_dir(format!("/proc/{}/task", self.id())).expect("the process runs");
        for task in tasks.flatten() {
            let listed = std::fs::read_to_string(task.path().join("children")).unwrap_or_default();
            children.extend(listed.split_whitespace().filter_map(|id| id.parse::<i32>().ok()));
        }
        children.sort_unstable();
        children
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

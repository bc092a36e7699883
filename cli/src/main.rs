//! The command line program: parses its arguments, runs the subcommand, and turns errors into one line and an exit code. Each
//! subcommand has a file of its own.

mod bench;
mod builtin;
mod cameras;
mod checkpoint;
mod compare;
mod doctor;
mod eval;
mod events;
mod export;
#[cfg(test)]
mod fuzz;
mod html;
mod interrupt;
mod journal;
mod lock;
mod machine;
mod memory;
mod output;
mod overwrite;
mod parse;
mod photographs;
mod precision;
mod prepare;
mod preview;
mod progress;
mod render;
mod run;
mod scene;
mod summary;
mod train;
mod view;
mod watch;

use std::path::Path;
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use raygrad::nerf::{Error, Result};
use raygrad::tensor::simd;

use interrupt::{Stop, Work};
use output::{complain, print};

/// How the program ends, for scripts.
const EXIT_CODES: &str = "\
Exit codes:
  0    done
  1    an error, or training that has diverged
  2    a command line that cannot be understood
  3    doctor has found something to be warned of
  4    doctor has found an error in the capture
  130  interrupted (Ctrl-C, SIGTERM, hang-up); what `train` has done is saved";

/// Neural radiance fields on a CPU: photographs and camera poses in, new views out.
///
/// Without a command, trains on a scene that is built in, for a minute or two, and renders a picture.
#[derive(Parser)]
#[command(name = "raygrad", version, after_help = EXIT_CODES)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    /// Threads to work with [default: as many as there are processors]
    #[arg(long, global = true, value_name = "N", value_parser = parse::count(1024))]
    threads: Option<usize>,
}

#[derive(Subcommand)]
enum Command {
    Prepare(prepare::Args),
    Train(train::Args),
    Eval(eval::Args),
    Compare(compare::Args),
    Render(render::Args),
    View(view::Args),
    Doctor(doctor::Args),
    Export(export::Args),
    Bench(bench::Args),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    run(cli).unwrap_or_else(|stop| match stop {
        Stop::Interrupted => interrupt::EXIT_CODE.into(),
        Stop::Failed(error) => {
            complain(&error.to_string());
            ExitCode::FAILURE
        }
    })
}

fn run(cli: Cli) -> Work<ExitCode> {
    simd::check_environment().map_err(|what| Error::setting("environment", what))?;
    if let Some(threads) = cli.threads {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
        pool.map_err(|e| Error::setting("threads", e))?;
    }
    match cli.command {
        None => return first_run(),
        Some(Command::Train(args)) => {
            let trained = train::run(&args)?;
            if !trained.diverged {
                suggest(&trained.folder)?;
            }
            return Ok(trained.exit_code());
        }
        Some(Command::Prepare(args)) => prepare::run(&args)?,
        Some(Command::Export(args)) => export::run(&args)?,
        Some(Command::Eval(args)) => eval::run(&args)?,
        Some(Command::Compare(args)) => compare::run(&args)?,
        Some(Command::Doctor(args)) => return Ok(doctor::run(&args)?),
        Some(Command::Bench(args)) => bench::run(&args)?,
        Some(Command::Render(args)) => render::run(&args)?,
        Some(Command::View(args)) => view::run(&args)?,
    }
    Ok(ExitCode::SUCCESS)
}

/// What the bare program does: trains with all defaults and renders a picture.
fn first_run() -> Work<ExitCode> {
    let trained = train::run(&train::Args::default())?;
    if !trained.interrupted && !trained.diverged {
        render::run(&render::Args::picture(&trained.folder))?;
    }
    if !trained.diverged {
        suggest(&trained.folder)?;
    }
    Ok(trained.exit_code())
}

/// Prints what can be done with a run.
fn suggest(folder: &Path) -> Result<()> {
    let folder = folder.display();
    print(&format!(
        "next     raygrad render {folder} --out {folder}/orbit.gif   to fly around the scene\n         \
         raygrad view {folder} --open   to look around in a browser\n         \
         raygrad eval {folder}   to measure it on views it has not seen\n"
    ))
}

#[cfg(test)]
mod tests {
    use super::Cli;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
        let _ = super::train::Args::default();
    }
}

//! The command line program: parses its arguments, runs the subcommand, and reports errors as one line and an exit
//! code. Each subcommand has its own file.

mod bench;
mod builtin;
mod cameras;
mod checkpoint;
mod compare;
mod completions;
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
mod man;
mod memory;
mod merge;
mod output;
mod overwrite;
mod parse;
mod photographs;
mod precision;
mod prepare;
mod preview;
mod progress;
mod ranks;
#[cfg(test)]
mod reference;
mod render;
mod run;
mod scene;
mod scratch;
mod shard;
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
use output::{complain_of, print, quoted};
use train::Trained;

/// Help text on exit codes.
const EXIT_CODES: &str = "\
Exit codes:
  0    success
  1    error, or training diverged
  2    invalid command line
  3    doctor found warnings
  4    doctor found errors in the capture
  130  interrupted (Ctrl-C, SIGTERM, hang-up); `train` saves its progress";

/// Neural radiance fields on a CPU: images and camera poses in, new views out
///
/// Without a command, raygrad trains on a built-in scene for 45 seconds and renders an image.
#[derive(Parser)]
#[command(name = "raygrad", version, after_help = EXIT_CODES, term_width = 80)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    /// Number of CPU threads [default: all]
    ///
    /// Range: 1 to 1024.
    #[arg(long, help_heading = "Advanced", global = true, value_name = "N", value_parser = parse::count(1024))]
    threads: Option<usize>,
}

#[derive(Subcommand)]
enum Command {
    Prepare(prepare::Args),
    Train(train::Args),
    Eval(eval::Args),
    Compare(compare::Args),
    Render(render::Args),
    Merge(merge::Args),
    View(view::Args),
    Doctor(doctor::Args),
    Export(export::Args),
    Bench(bench::Args),
    Completions(completions::Args),
    Man(man::Args),
}

fn main() -> ExitCode {
    let code = match run(Cli::parse()) {
        Ok(code) => code,
        Err(Stop::Interrupted) => {
            ranks::fail(interrupt::EXIT_CODE);
            interrupt::EXIT_CODE.into()
        }
        Err(Stop::Failed(error)) => {
            complain_of(&error);
            ranks::fail(1);
            ExitCode::FAILURE
        }
    };
    ranks::finish();
    code
}

fn run(cli: Cli) -> Work<ExitCode> {
    interrupt::end_at_signals();
    simd::check_environment().map_err(|what| Error::setting("environment", what))?;
    let is_shared = match &cli.command {
        None | Some(Command::Train(_)) => true,
        Some(Command::Render(args)) => args.shard.is_none(),
        Some(Command::Eval(args)) => args.shard.is_none(),
        _ => false,
    };
    if is_shared {
        ranks::start(cli.threads.is_some())?;
    }
    if let Some(threads) = cli.threads {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
        pool.map_err(|e| Error::setting("threads", e))?;
    }
    match cli.command {
        None => return first_run(&train::Args::default()),
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
        Some(Command::Completions(args)) => completions::run(&args)?,
        Some(Command::Man(args)) => man::run(&args)?,
        Some(Command::Render(args)) => render::run(&args)?,
        Some(Command::Merge(args)) => merge::run(&args)?,
        Some(Command::View(args)) => view::run(&args)?,
    }
    Ok(ExitCode::SUCCESS)
}

/// What the bare program does: trains, and renders an image if training came to its end.
fn first_run(args: &train::Args) -> Work<ExitCode> {
    let trained = train::run(args)?;
    if ranks::is_silent() {
        return Ok(trained.exit_code());
    }
    end_first_run(&trained, |folder| render::run(&render::Args::picture(folder)))
}

/// Renders if training came to its end, and prints what can be done with the run unless it diverged.
fn end_first_run(trained: &Trained, render: impl FnOnce(&Path) -> Work<()>) -> Work<ExitCode> {
    if trained.is_complete() {
        render(&trained.folder)?;
    }
    if !trained.diverged {
        suggest(&trained.folder)?;
    }
    Ok(trained.exit_code())
}

/// Prints the next commands for a run.
fn suggest(folder: &Path) -> Result<()> {
    let [folder, orbit] = [folder, &folder.join("orbit.gif")].map(quoted);
    print(&format!(
        "next     raygrad render {folder} --out {orbit}   to render an orbit video\n         raygrad view \
         {folder} --open   to open the viewer\n         raygrad eval {folder}   to measure it on held-out images\n"
    ))
}

#[cfg(test)]
mod tests {
    use super::Cli;
    use clap::{Command, CommandFactory, Parser};
    use std::path::Path;
    use std::process::ExitCode;

    /// The program and its commands, ready to print help.
    pub fn commands() -> Vec<Command> {
        let mut program = Cli::command();
        program.build();
        let commands = program.get_subcommands().filter(|command| command.get_name() != "help").cloned();
        let commands: Vec<Command> = commands.collect();
        std::iter::once(program).chain(commands).collect()
    }

    #[test]
    fn clap_definition_passes_debug_assert() {
        Cli::command().debug_assert();
        let _ = super::train::Args::default();
    }

    #[test]
    fn first_run_trains_and_renders_an_image() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("run");
        let small = "train --steps 1 --downscale 20 --set field.grid.levels=2 --set field.grid.log2_table=8 \
                     --set sampler.occupancy.resolution=16 --set sampler.samples=64 --set sampler.step=0.05 \
                     --set sampler.view_step=0.05 --out";
        let args = super::train::Args::parse_from(small.split_whitespace().chain(run.to_str()));
        assert!(super::first_run(&args).is_ok_and(|code| code == ExitCode::SUCCESS));
        let image = raygrad::nerf::Image::open(run.join("render.png")).unwrap();
        assert_eq!([image.width, image.height], [10, 10]);
    }

    #[test]
    fn first_run_renders_after_complete_training() {
        for (interrupted, diverged, renders, code) in [
            (false, false, true, ExitCode::SUCCESS),
            (true, false, false, ExitCode::from(130)),
            (false, true, false, ExitCode::FAILURE),
            (true, true, false, ExitCode::from(130)),
        ] {
            let trained = super::Trained { folder: "run".into(), interrupted, diverged };
            let mut rendered = vec![];
            let ended = super::end_first_run(&trained, |folder| {
                rendered.push(folder.to_owned());
                Ok(())
            });
            assert!(ended.is_ok_and(|ended| ended == code), "{interrupted} {diverged}");
            assert_eq!(rendered, vec![Path::new("run"); usize::from(renders)], "{interrupted} {diverged}");
        }
    }

    #[test]
    fn short_help_has_one_line_an_option() {
        for mut command in commands() {
            let help = command.render_help().to_string();
            for line in help.lines() {
                assert!(!line.starts_with(&" ".repeat(12)), "{}: wrapped: {line}", command.get_name());
                assert!(line.chars().count() <= 80, "{}: {line}", command.get_name());
                if let Some(option) = line.trim_start().strip_prefix('-') {
                    assert!(option.contains("  "), "{}: no description beside {line}", command.get_name());
                }
            }
            let options = command.get_arguments().filter(|option| !option.is_hide_set() && !option.is_positional());
            let lines = help.lines().filter(|line| line.trim_start().starts_with('-')).count();
            assert_eq!(lines, options.count(), "{help}");
        }
    }

    /// `UPDATE_SNAPSHOTS=1 cargo test -p raygrad-cli --bin raygrad help` updates the snapshots.
    #[test]
    fn help_equals_snapshots() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/help");
        for mut command in commands() {
            let name = command.get_name().to_owned();
            let text = format!("{}\n---\n\n{}", command.render_help(), command.render_long_help());
            let text: String = text.lines().map(|line| format!("{}\n", line.trim_end())).collect();
            assert!(text.lines().all(|line| line.chars().count() <= 80), "{name}: a line is longer than 80:\n{text}");
            let file = folder.join(format!("{name}.txt"));
            if std::env::var_os("UPDATE_SNAPSHOTS").is_some() {
                std::fs::create_dir_all(&folder).unwrap();
                std::fs::write(&file, &text).unwrap();
            }
            let expected = std::fs::read_to_string(&file).unwrap_or_default();
            assert_eq!(
                text,
                expected,
                "`raygrad {name} --help` has changed; UPDATE_SNAPSHOTS=1 writes {}",
                file.display()
            );
        }
    }
}

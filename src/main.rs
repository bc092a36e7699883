//! The command line program; `cli` has a file for each subcommand.

mod cli;

fn main() -> std::process::ExitCode {
    cli::main()
}

//! `raygrad completions`: completion scripts for shells.

use clap::CommandFactory;
use clap_complete::Shell;
use raygrad::nerf::{Error, Result};

use super::Cli;
use super::output::print;

/// Print a shell completion script
///
/// Load it from the startup file of the shell, or save it where the shell looks for completions.
///
/// Example: source <(raygrad completions bash)
#[derive(clap::Args)]
pub struct Args {
    /// bash, zsh, fish, powershell or elvish
    #[arg(value_enum, hide_possible_values = true)]
    shell: Shell,
}

pub fn run(args: &Args) -> Result<()> {
    print(&script(args.shell)?)
}

/// The completion script for a shell.
fn script(shell: Shell) -> Result<String> {
    let mut text = vec![];
    clap_complete::generate(shell, &mut Cli::command(), "raygrad", &mut text);
    String::from_utf8(text).map_err(|e| Error::setting("completions", e))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::commands;
    use clap::ValueEnum;

    #[test]
    fn completions_contain_all_commands_and_flags() {
        for shell in Shell::value_variants() {
            let script = script(*shell).unwrap();
            for command in commands() {
                let name = command.get_name();
                assert!(script.contains(name), "{shell}: {name}");
                for flag in command.get_arguments().filter(|arg| !arg.is_hide_set()).filter_map(|arg| arg.get_long()) {
                    assert!(script.contains(flag), "{shell}: {name} --{flag}");
                }
            }
        }
    }
}

//! `raygrad man`: manual pages.

use std::path::{Path, PathBuf};

use clap::CommandFactory;
use clap_mangen::Man;
use raygrad::nerf::{Error, Result, write_atomic};

use super::Cli;
use super::output::{make_folder, print};

/// Print the man page, or write all pages
///
/// Without --out, prints the page of raygrad itself. With --out, writes it as raygrad.1, and one page per command:
/// raygrad-train.1, raygrad-render.1 and so on.
///
/// Example: raygrad man --out ~/.local/share/man/man1
#[derive(clap::Args)]
pub struct Args {
    /// Folder for the pages of all commands
    ///
    /// raygrad replaces only pages that `raygrad man` wrote.
    #[arg(long, help_heading = "Output", value_name = "DIR")]
    out: Option<PathBuf>,
}

pub fn run(args: &Args) -> Result<()> {
    let pages = pages()?;
    let Some(folder) = &args.out else { return print(&pages[0].1) };
    make_folder(folder)?;
    let files: Vec<(PathBuf, String)> = pages.into_iter().map(|(name, page)| (folder.join(name), page)).collect();
    files.iter().try_for_each(|(file, _)| check_replaceable(file))?;
    files.iter().try_for_each(|(file, page)| write_atomic(file, page.as_bytes()))?;
    print(&format!("{} pages in {}\n", files.len(), folder.display()))
}

/// The title line, which marks generated pages.
const TITLE: &str = "\n.TH raygrad";

/// Fails if the path exists and is not a page of raygrad.
fn check_replaceable(file: &Path) -> Result<()> {
    match std::fs::read(file) {
        Ok(bytes) if !String::from_utf8_lossy(&bytes).contains(TITLE) => {
            Err(Error::file(file, "is not a page of `raygrad man`: move it, or choose another --out"))
        }
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::file(file, format!("cannot be read: {e}"))),
        _ => Ok(()),
    }
}

/// File names and texts of the pages: the program first, then one per command.
fn pages() -> Result<Vec<(String, String)>> {
    let mut program = Cli::command().disable_help_subcommand(true);
    program.build();
    let commands: Vec<_> = std::iter::once(program.clone()).chain(program.get_subcommands().cloned()).collect();
    let page = |command: clap::Command| {
        let name = command.get_display_name().unwrap_or("raygrad").to_owned();
        let man = Man::new(command).source(format!("raygrad {}", env!("CARGO_PKG_VERSION")));
        let mut text = vec![];
        man.render(&mut text).map_err(|e| Error::setting("man", e))?;
        let text = String::from_utf8(text).map_err(|e| Error::setting("man", e))?;
        // The heading of the section after the options.
        Ok((format!("{name}.1"), text.replace(".SH EXTRA\nExit codes:\n", ".SH \"EXIT CODES\"\n")))
    };
    commands.into_iter().map(page).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::commands;

    #[test]
    fn pages_cover_all_commands_and_flags() {
        let pages = pages().unwrap();
        let names: Vec<&str> = pages.iter().map(|(name, _)| name.as_str()).collect();
        assert!(pages[0].1.contains(".SH \"EXIT CODES\""), "{}", pages[0].1);
        for command in commands() {
            let name = command.get_name();
            let file = if name == "raygrad" { "raygrad.1".to_owned() } else { format!("raygrad-{name}.1") };
            let (_, page) = pages.iter().find(|(name, _)| *name == file).unwrap_or_else(|| panic!("{file}: {names:?}"));
            assert!(page.contains(TITLE), "{page}");
            for flag in command.get_arguments().filter(|arg| !arg.is_hide_set()).filter_map(|arg| arg.get_long()) {
                assert!(page.replace('\\', "").contains(&format!("--{flag}")), "{file}: {flag}");
            }
            // The program's page refers to the others.
            assert!(
                name == "raygrad" || pages[0].1.replace('\\', "").contains(&format!("raygrad-{name}(1)")),
                "{name}"
            );
        }
    }

    #[test]
    fn check_replaceable_accepts_own_pages_only() {
        let folder = tempfile::tempdir().unwrap();
        let args = Args { out: Some(folder.path().join("man1")) };
        run(&args).unwrap();
        run(&args).unwrap();
        let foreign = folder.path().join("man1/raygrad-train.1");
        std::fs::write(&foreign, "mine").unwrap();
        let error = run(&args).unwrap_err().to_string();
        let expected = "is not a page of `raygrad man`: move it, or choose another --out";
        assert_eq!(error, format!("{}: {expected}", foreign.display()));
        assert_eq!(std::fs::read(&foreign).unwrap(), b"mine");
    }
}

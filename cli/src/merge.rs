//! `raygrad merge`: makes the result of complete shards.

use std::path::{Path, PathBuf};
use std::time::Duration;

use raygrad::nerf::Error;

use super::interrupt::{self, Stop, Work};
use super::output::{entries, print, quoted};
use super::prepare::convert;
use super::shard::{self, Complete, Progress, Shard};
use super::{eval, ranks, render};

/// Merge shards of `render`, `eval` or `prepare`
///
/// The last shard to finish merges all of them. Use this command if that shard was killed, or if two shards finished at
/// the same moment on different machines.
///
/// Example: raygrad merge orbit.mp4
#[derive(clap::Args)]
pub struct Args {
    /// The --out of the shards; of `eval` the run, or its folder RUN/eval-SPLIT-SKIP
    out: PathBuf,
}

/// Runs the command.
pub fn run(args: &Args) -> Work<()> {
    interrupt::listen_to_go_on();
    let out = &args.out;
    let mut places = vec![out.clone(), render::frames_of(out)];
    places.extend(convert::staging(out));
    places.extend(entries(out).unwrap_or_default());
    places.retain(|place| place.join(shard::FOLDER).is_dir());
    // A run may have several results.
    let (mut has_merged, mut left) = (false, None);
    for at in places {
        // The result is beside it, and `.` has no name.
        let at = if at.file_name().is_none() { at.canonicalize().unwrap_or(at) } else { at };
        let named = if at.starts_with(out) { &at } else { out };
        let what = match shard::progress(&at) {
            Ok(Progress::Complete(complete)) => match merge(*complete) {
                Err(Stop::Failed(error)) => Err(error),
                merged => {
                    merged?;
                    has_merged = true;
                    continue;
                }
            },
            Ok(Progress::None) => continue,
            Ok(Progress::Merging) => Ok("another raygrad merges the shards: wait until it ends".into()),
            Ok(Progress::Incomplete(missing)) => {
                Ok(format!("misses shards {missing}: wait for those that run, repeat the others with --shard"))
            }
            Err(error) => Err(error),
        };
        left.get_or_insert_with(|| what.map_or_else(|error| error, |what| Error::file(named, what)));
    }
    let none = || Error::file(out, "holds no shards: name the --out of `render` or `prepare`, or the run of `eval`");
    match left.or_else(|| (!has_merged).then(none)) {
        Some(error) => Err(error.into()),
        None => Ok(()),
    }
}

/// Merges the shards in a folder of results if all are complete. Called after `shard` is. Of several ranks, rank 0
/// merges them when all are here.
pub fn merge_if_complete(at: &Path, shard: Shard) -> Work<()> {
    if !ranks::wait()? {
        return Ok(());
    }
    if ranks::own().is_some() {
        return merge_ranks(at);
    }
    let rest = match shard::progress(at)? {
        Progress::Complete(complete) => return merge(*complete),
        Progress::None => "another raygrad has merged the shards".into(),
        Progress::Merging => "another raygrad merges the shards".into(),
        Progress::Incomplete(missing) => format!("still missing {missing}"),
    };
    Ok(print(&format!("shard    {shard} is complete; {rest}\n"))?)
}

/// Merges the shards of ranks, all of which are complete. On a network file system, some may show a little later.
fn merge_ranks(at: &Path) -> Work<()> {
    /// Looks, half a second apart. Clients of NFS may not look at a folder again for a minute.
    const LOOKS: usize = 150;
    let (mut rest, mut is_merging) = (String::new(), false);
    for _ in 0..LOOKS {
        rest = match shard::progress(at)? {
            Progress::Complete(complete) => return merge(*complete),
            Progress::None if is_merging => return Ok(()),
            Progress::None => "; there are none".into(),
            Progress::Merging => {
                is_merging = true;
                "; another raygrad merges them".into()
            }
            Progress::Incomplete(missing) => format!("; still missing {missing}"),
        };
        if interrupt::requested() {
            break;
        }
        std::thread::sleep(Duration::from_millis(500));
    }
    let what = format!(
        "does not show the results of all ranks{rest}: use a file system that all share, or run `raygrad merge {}` later",
        quoted(at)
    );
    Err(Error::file(at, what).into())
}

fn merge(complete: Complete) -> Work<()> {
    match complete.whole.command.as_str() {
        render::COMMAND => render::merge(complete),
        convert::COMMAND => convert::merge(complete),
        eval::COMMAND => Ok(eval::merge(complete)?),
        other => {
            let what = format!(
                "holds shards of `raygrad {other}`, which this raygrad cannot merge: use the one that made them"
            );
            Err(Error::file(complete.at(), what).into())
        }
    }
}

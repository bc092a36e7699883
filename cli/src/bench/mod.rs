//! `raygrad bench`: run time against error, as tables, plots and one page.

mod draw;
mod figure;
mod kernels;
mod quadrature;
mod render;
mod report;
mod stopwatch;
mod table;
mod train;

use std::path::{Path, PathBuf};

use clap::ValueEnum;
use raygrad::nerf::{Error, Result};
use serde_json::Value;

use super::output::{make_folder, note, print};
use super::overwrite::Job;
pub use draw::bitmap;
use figure::Figure;
use table::Table;

/// Measure run time against error
///
/// Writes CSV tables, SVG and PNG plots, and one page with all of them. Counts of work stand beside every time.
/// Times are medians of runs interleaved with a baseline (A B B A); a control run shows the noise.
///
/// Example: raygrad bench --quick --suite render
#[derive(clap::Args)]
pub struct Args {
    /// quadrature, kernels, render, train or all
    ///
    /// quadrature: integration rules on scenes with exact solutions. kernels: elementary functions, matrix
    /// products, the hash grid. render: renderer settings on one trained model. train: quality against training
    /// time.
    #[arg(long, help_heading = "Scene", hide_possible_values = true, value_enum, default_value_t = Suite::All)]
    suite: Suite,
    /// A short form: two minutes on two cores
    #[arg(long, help_heading = "Time")]
    quick: bool,
    /// Folder for the results
    ///
    /// They replace those of an earlier benchmark.
    #[arg(long, help_heading = "Output", value_name = "DIR", default_value = "bench")]
    out: PathBuf,
    /// Write to a folder that holds other files
    ///
    /// Replaces files of the same names.
    #[arg(long, help_heading = "Output")]
    overwrite: bool,
    /// Also time PyTorch and JAX, if installed
    ///
    /// Works in a checkout of the repository only.
    #[arg(long, help_heading = "Advanced")]
    peers: bool,
    /// Render this run, not the built-in scene
    #[arg(long, help_heading = "Scene", value_name = "RUN")]
    run: Option<PathBuf>,
}

/// A group of measurements.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Suite {
    /// Rules for the integral along a ray, on scenes known exactly
    Quadrature,
    /// Elementary functions, matrix products, the hash grid
    Kernels,
    /// Settings of the renderer, on one trained model
    Render,
    /// Quality against training time
    Train,
    /// Everything
    All,
}

/// Results of a suite.
#[derive(Debug, Default)]
pub struct Results {
    /// Tables, in order.
    pub tables: Vec<Table>,
    /// Figures, in order.
    pub figures: Vec<Figure>,
    /// Summary sentences.
    pub findings: Vec<String>,
}

/// Runs the suites and writes the files.
pub fn run(args: &Args) -> Result<()> {
    let (job, page) = (Job::new("bench", &Value::Null, args.overwrite), args.out.join("report.html"));
    check_folder(&args.out, &page, &job)?;
    make_folder(&args.out)?;
    // An empty page marks the folder as a benchmark, even if this run fails.
    if !job.wrote(&page) {
        report::save(&page, &[], args.quick, job.mark())?;
    }
    let wanted = |suite| args.suite == suite || args.suite == Suite::All;
    let mut sections = vec![];
    if wanted(Suite::Quadrature) {
        note("quadrature: integration rules on scenes with exact solutions");
        sections.push(save(
            "Quadrature",
            "--suite quadrature",
            on_one_thread(|| quadrature::run(args.quick))?,
            &args.out,
        )?);
    }
    if wanted(Suite::Kernels) {
        note("kernels: elementary functions, matrix products, the hash grid");
        sections.push(save("Kernels", "--suite kernels", on_one_thread(|| kernels::run(args.quick))??, &args.out)?);
    }
    if wanted(Suite::Render) {
        note("render: renderer settings on one model");
        sections.push(save("Rendering", "--suite render", render::run(args.quick, args.run.as_deref())?, &args.out)?);
    }
    if wanted(Suite::Train) {
        note("train: quality against training time");
        sections.push(save("Training", "--suite train", train::run(args.quick, args.peers)?, &args.out)?);
    }
    report::save(&page, &sections, args.quick, job.mark())?;
    let findings = sections.iter().flat_map(|section| &section.findings);
    let findings: String = findings.map(|finding| format!("{finding}\n")).collect();
    print(&format!("{findings}written: {}; tables and plots are in the same folder\n", page.display()))
}

/// Fails unless the folder is new or empty, or an earlier benchmark wrote its page.
fn check_folder(folder: &Path, page: &Path, job: &Job) -> Result<()> {
    let is_taken = std::fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_some());
    if is_taken && !job.overwrites() && !job.wrote(page) {
        let what = "holds files of something else: choose another --out or add --overwrite";
        return Err(Error::file(folder, what));
    }
    Ok(())
}

/// Runs `f` on one thread.
fn on_one_thread<R: Send>(f: impl FnOnce() -> R + Send) -> Result<R> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    Ok(pool.map_err(|e| Error::setting("threads", e))?.install(f))
}

/// Saves the tables and figures of a suite.
fn save(title: &str, command: &str, results: Results, folder: &Path) -> Result<report::Section> {
    results.tables.iter().try_for_each(|table| table.save(folder))?;
    let drawn = results.figures.into_iter().map(|figure| Ok((draw::save(&figure, folder)?, figure.caption)));
    Ok(report::Section {
        title: title.to_owned(),
        command: format!("raygrad bench {command}"),
        figures: drawn.collect::<Result<_>>()?,
        tables: results.tables,
        findings: results.findings,
    })
}

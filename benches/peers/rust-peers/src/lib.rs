//! What both programs share: the shapes, the stopwatch and the line of JSON, which are those of `../ops.py`.

use std::time::Instant;

pub const MLP: &str = "train MLP 32-64-64-64-3, 256 rows, MSE";
pub const DENSE: &str = "train MLP 784-512-512-10, 128 rows, cross entropy";
pub const CNN: &str = "train CNN 8-16, 64 images 28x28, cross entropy";

/// Seconds of each call after a tenth as many that are not timed: their median.
pub fn median(repeats: usize, mut f: impl FnMut()) -> f64 {
    let mut times = Vec::new();
    for i in 0..repeats + repeats.div_ceil(10) {
        let start = Instant::now();
        f();
        if i >= repeats.div_ceil(10) {
            times.push(start.elapsed().as_secs_f64());
        }
    }
    times.sort_by(f64::total_cmp);
    times[repeats / 2]
}

/// Which of the groups `scalars`, `training`, `operations` are asked for; all if none is named.
pub fn asked(group: &str) -> bool {
    let names: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    names.is_empty() || names.iter().any(|name| name == group)
}

/// One line of JSON.
pub fn report(framework: &str, what: &str, figures: &[(&str, f64)]) {
    let mut line = serde_json::json!({ "framework": framework, "what": what });
    for &(name, value) in figures {
        line[name] = value.into();
    }
    line["peak_rss_bytes"] = peak_rss().into();
    line["threads"] = std::thread::available_parallelism().map_or(1, usize::from).into();
    println!("{line}");
}

fn peak_rss() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(1024 * line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?)
}

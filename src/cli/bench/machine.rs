//! What the figures were measured on.

use raygrad::tensor::simd;

/// The name and the value of each property.
pub fn describe() -> Vec<[String; 2]> {
    let row = |name: &str, value: String| [name.to_owned(), value];
    let mut rows = vec![
        row("processor", processor()),
        row("instruction set in use", simd::name().to_owned()),
        row("threads", rayon::current_num_threads().to_string()),
        row("system", format!("{} {}", std::env::consts::OS, std::env::consts::ARCH)),
    ];
    rows.extend(caches().into_iter().map(|(name, bytes)| row(&name, format!("{} KiB", bytes / 1024))));
    if let Some(memory) = proc_value("/proc/meminfo", "MemTotal") {
        rows.push(row("memory", memory));
    }
    rows.push(row("raygrad", env!("CARGO_PKG_VERSION").to_owned()));
    rows
}

/// The name of the processor, where the system says it.
pub fn processor() -> String {
    proc_value("/proc/cpuinfo", "model name").unwrap_or_else(|| "unknown".to_owned())
}

/// The value after the first `name:` of a file of Linux.
fn proc_value(file: &str, name: &str) -> Option<String> {
    let text = std::fs::read_to_string(file).ok()?;
    let line = text.lines().find(|line| line.split(':').next().is_some_and(|key| key.trim() == name))?;
    Some(line.split_once(':')?.1.trim().to_owned())
}

/// The data caches of the first processor and their sizes in bytes, where the system says so.
pub fn caches() -> Vec<(String, u64)> {
    let read = |index: usize, what: &str| {
        let path = format!("/sys/devices/system/cpu/cpu0/cache/index{index}/{what}");
        std::fs::read_to_string(path).map(|text| text.trim().to_owned()).ok()
    };
    let cache = |index: usize| {
        if read(index, "type")? == "Instruction" {
            return None;
        }
        let size = read(index, "size")?;
        let kib: u64 = size.strip_suffix('K')?.parse().ok()?;
        Some((format!("cache L{}", read(index, "level")?), 1024 * kib))
    };
    (0..8).filter_map(cache).collect()
}

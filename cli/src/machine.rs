//! Properties of the machine and of the process, for results.

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

/// The processor's name, if the system reports it.
pub fn processor() -> String {
    proc_value("/proc/cpuinfo", "model name").unwrap_or_else(|| "unknown".to_owned())
}

/// Peak memory of this process in bytes, if the system reports it.
pub fn peak_memory() -> Option<u64> {
    proc_bytes("/proc/self/status", "VmHWM")
}

/// Current memory of this process in bytes, if the system reports it.
pub fn taken_memory() -> Option<u64> {
    proc_bytes("/proc/self/status", "VmRSS")
}

/// The first `name:` value of a file in `/proc`, converted from kB to bytes.
fn proc_bytes(file: &str, name: &str) -> Option<u64> {
    let kib: u64 = proc_value(file, name)?.strip_suffix("kB")?.trim().parse().ok()?;
    Some(1024 * kib)
}

/// The first `name:` value of a file in `/proc`.
fn proc_value(file: &str, name: &str) -> Option<String> {
    let text = std::fs::read_to_string(file).ok()?;
    let line = text.lines().find(|line| line.split(':').next().is_some_and(|key| key.trim() == name))?;
    Some(line.split_once(':')?.1.trim().to_owned())
}

/// Data caches of the first processor with their sizes in bytes, if the system reports them.
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

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn memory_values_are_in_bytes() {
        let before = peak_memory().unwrap();
        let block = std::hint::black_box(vec![1_u8; 1 << 28]);
        let grown = peak_memory().unwrap() - before;
        // Memory that was freed before does not raise the peak.
        assert!(before > 1 << 20 && before < 1 << 36 && grown <= block.len() as u64 + (1 << 26), "{before} {grown}");
        assert!(peak_memory().unwrap() >= block.len() as u64);
    }
}

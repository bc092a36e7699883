//! Free memory of the machine.

use std::fs::read_to_string;
use std::path::Path;

/// Returns the free memory in bytes: of the machine, or of this process's control group if that has less left. `None` if
/// the system does not tell; Linux does.
///
/// Memory that the system can take back, such as cached files, counts as free.
pub fn available_memory() -> Option<u64> {
    let groups = read_to_string("/proc/self/cgroup").unwrap_or_default();
    let groups = groups.lines().filter_map(|line| line.strip_prefix("0::"));
    let groups = groups.flat_map(|name| {
        Path::new("/sys/fs/cgroup")
            .join(name.trim_start_matches('/'))
            .ancestors()
            .map(Path::to_owned)
            .collect::<Vec<_>>()
    });
    let limits =
        groups.take_while(|folder| folder.starts_with("/sys/fs/cgroup")).filter_map(|folder| left_of_group(&folder));
    limits.chain(left_of_machine(&read_to_string("/proc/meminfo").ok()?)).min()
}

/// The free memory of the machine, from `/proc/meminfo`.
fn left_of_machine(text: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    Some(1024 * line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?)
}

/// What a control group may still use; `None` without a limit.
fn left_of_group(folder: &Path) -> Option<u64> {
    let read = |name: &str| read_to_string(folder.join(name)).ok();
    let number = |name: &str| read(name)?.trim().parse::<u64>().ok();
    let (limit, used) = (number("memory.max")?, number("memory.current")?);
    // Files that were not used lately are dropped first.
    let cached = read("memory.stat")
        .and_then(|text| text.lines().find_map(|line| line.strip_prefix("inactive_file ")?.trim().parse::<u64>().ok()));
    Some(limit.saturating_sub(used.saturating_sub(cached.unwrap_or(0))))
}

/// Bytes in gigabytes, as in messages.
pub(crate) fn gigabytes(bytes: u64) -> String {
    format!("{:.1} GB", bytes as f64 / 1e9)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn machine_and_group_limit_free_memory() {
        let text = "MemTotal:       16000000 kB\nMemFree:  1 kB\nMemAvailable:    8000000 kB\n";
        assert_eq!(left_of_machine(text), Some(8_192_000_000));
        assert_eq!([left_of_machine(""), left_of_machine("MemAvailable: x kB")], [None, None]);
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        assert_eq!(left_of_group(folder.path()), None);
        write("memory.max", "1000\n");
        write("memory.current", "700\n");
        assert_eq!(left_of_group(folder.path()), Some(300));
        write("memory.stat", "anon 500\ninactive_file 150\nactive_file 50\n");
        assert_eq!(left_of_group(folder.path()), Some(450));
        write("memory.current", "1200\n");
        assert_eq!(left_of_group(folder.path()), Some(0));
        write("memory.max", "max\n");
        assert_eq!(left_of_group(folder.path()), None);
        assert_eq!(gigabytes(1_250_000_000), "1.2 GB");
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn free_memory_is_at_most_that_of_the_machine() {
        let machine = left_of_machine(&read_to_string("/proc/meminfo").unwrap()).unwrap();
        let free = available_memory().unwrap();
        assert!(free > 0 && free < machine + machine / 2, "{free} {machine}");
    }
}

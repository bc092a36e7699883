//! Free memory of the machine.

use std::fs::read_to_string;
use std::path::{Path, PathBuf};

/// Returns the free memory in bytes, with swap space: of the machine, or of this process's control group (version 1 or 2)
/// if that has less left. `None` if the system does not tell; Linux does.
///
/// Memory that the system can take back, such as that of cached files, counts as free.
pub fn available_memory() -> Option<u64> {
    let groups = read_to_string("/proc/self/cgroup").unwrap_or_default();
    let limits = groups.lines().flat_map(folders_of_group).filter_map(|folder| left_of_group(&folder));
    limits.chain(left_of_machine(&read_to_string("/proc/meminfo").ok()?)).min()
}

/// The free memory of the machine, from `/proc/meminfo`.
fn left_of_machine(text: &str) -> Option<u64> {
    let value = |name: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'))?;
        line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()
    };
    Some(1024 * (value("MemAvailable")? + value("SwapFree").unwrap_or(0)))
}

/// The folders of a control group and of the groups around it, by a line of `/proc/self/cgroup`; none if the line is not
/// about memory. In a container, the group may be mounted at the root.
fn folders_of_group(line: &str) -> Vec<PathBuf> {
    let mut parts = line.splitn(3, ':').skip(1);
    let (Some(kind), Some(name)) = (parts.next(), parts.next()) else { return vec![] };
    let root = match kind {
        "" => Path::new("/sys/fs/cgroup"),
        "memory" => Path::new("/sys/fs/cgroup/memory"),
        _ => return vec![],
    };
    let inner = match name.trim_start_matches('/') {
        "" => root.to_owned(),
        name => root.join(name),
    };
    inner.ancestors().take_while(|folder| folder.starts_with(root)).map(Path::to_owned).collect()
}

/// What a control group may still use; `None` without a limit.
fn left_of_group(folder: &Path) -> Option<u64> {
    let read = |name: &str| read_to_string(folder.join(name)).ok();
    let number = |names: [&str; 2]| names.into_iter().find_map(read)?.trim().parse::<u64>().ok();
    let limit = number(["memory.max", "memory.limit_in_bytes"])?;
    let used = number(["memory.current", "memory.usage_in_bytes"])?;
    let stat = read("memory.stat").unwrap_or_default();
    // What the system drops first when memory is short: files in its cache, and its own caches.
    let cached = ["inactive_file ", "active_file ", "slab_reclaimable "]
        .into_iter()
        .filter_map(|name| stat.lines().find_map(|line| line.strip_prefix(name)?.trim().parse::<u64>().ok()));
    Some(limit.saturating_sub(used.saturating_sub(cached.sum())))
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
        assert_eq!(left_of_machine(&format!("{text}SwapTotal: 9 kB\nSwapFree:   2 kB\n")), Some(8_192_002_048));
        assert_eq!([left_of_machine(""), left_of_machine("MemAvailable: x kB")], [None, None]);
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        assert_eq!(left_of_group(folder.path()), None);
        write("memory.max", "1000\n");
        write("memory.current", "700\n");
        assert_eq!(left_of_group(folder.path()), Some(300));
        write("memory.stat", "anon 500\ninactive_file 150\nactive_file 50\n");
        assert_eq!(left_of_group(folder.path()), Some(500));
        write("memory.current", "1200\n");
        assert_eq!(left_of_group(folder.path()), Some(0));
        write("memory.max", "max\n");
        assert_eq!(left_of_group(folder.path()), None);
        for name in ["memory.max", "memory.current"] {
            std::fs::remove_file(folder.path().join(name)).unwrap();
        }
        write("memory.limit_in_bytes", "900\n");
        write("memory.usage_in_bytes", "600\n");
        assert_eq!(left_of_group(folder.path()), Some(500));
        assert_eq!(gigabytes(1_250_000_000), "1.2 GB");
    }

    #[test]
    fn groups_of_memory_are_found_in_both_versions() {
        let folders = |line: &str| {
            let folders = folders_of_group(line).into_iter();
            folders.map(|folder| folder.to_str().unwrap().to_owned()).collect::<Vec<_>>()
        };
        assert_eq!(folders("0::/"), ["/sys/fs/cgroup"]);
        assert_eq!(folders("0::/a/b"), ["/sys/fs/cgroup/a/b", "/sys/fs/cgroup/a", "/sys/fs/cgroup"]);
        assert_eq!(folders("9:memory:/a"), ["/sys/fs/cgroup/memory/a", "/sys/fs/cgroup/memory"]);
        assert_eq!([folders("8:pids:/a"), folders("x"), folders("")], [const { vec![] }; 3] as [Vec<String>; 3]);
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn free_memory_is_at_most_that_of_the_machine() {
        let machine = left_of_machine(&read_to_string("/proc/meminfo").unwrap()).unwrap();
        let free = available_memory().unwrap();
        // Other programs take and free memory meanwhile.
        assert!(free > 0 && free < machine + machine / 8, "{free} {machine}");
    }
}

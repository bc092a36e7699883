//! The root folder of a dataset's files, with links resolved.

use std::path::{Path, PathBuf};

use raygrad::nerf::dataset::{Capture, Format};
use raygrad::nerf::{Error, Result};

/// A folder whose files may be copied into a dataset that people share.
pub struct Root(PathBuf);

impl Root {
    /// Creates the root of an existing folder.
    pub fn new(folder: &Path) -> Result<Self> {
        resolved(folder).map(Root).map_err(|what| Error::file(folder, what))
    }

    /// The folder of a capture. For a COLMAP model in `scene/sparse/0` or `scene/sparse`, it is `scene`, which holds
    /// the images.
    pub fn of_capture(capture: &Capture) -> Result<Self> {
        let Root(whole) = Self::new(&capture.folder)?;
        let sparse = whole.ancestors().take(2).find(|folder| folder.ends_with("sparse"));
        let scene = sparse.and_then(Path::parent).filter(|_| capture.format == Format::Colmap);
        Ok(Root(scene.unwrap_or(&whole).to_owned()))
    }

    /// Fails with the reason and the fix if a file is outside of the folder.
    pub fn check(&self, file: &Path) -> std::result::Result<(), String> {
        if resolved(file)?.starts_with(&self.0) {
            return Ok(());
        }
        let (file, root) = (file.display(), self.0.display());
        Err(format!("{file} lies outside of {root}: add --allow-outside to copy it"))
    }
}

/// The path with links resolved.
fn resolved(path: &Path) -> std::result::Result<PathBuf, String> {
    path.canonicalize().map_err(|e| format!("{} cannot be found: {e}", path.display()))
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::symlink;

    #[test]
    fn check_refuses_links_out_of_the_root() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        fs::create_dir_all(path("scene/sparse/0")).unwrap();
        fs::create_dir_all(path("scene2")).unwrap();
        for name in ["scene/a.png", "scene2/b.png", "c.png"] {
            fs::write(path(name), "").unwrap();
        }
        symlink(path("c.png"), path("scene/link.png")).unwrap();
        symlink(path("scene/a.png"), path("scene/within.png")).unwrap();
        symlink(path("scene2"), path("scene/folder")).unwrap();
        symlink(path("scene"), path("named")).unwrap();
        let inside = ["scene/a.png", "scene/within.png", "named/a.png", "scene2/../scene/a.png"];
        let outside = ["c.png", "scene/link.png", "scene/folder/b.png", "scene/../scene2/b.png", "named/link.png"];
        let of = |folder: &str, format: Format| {
            Root::of_capture(&Capture::new(&path(folder), path("cameras"), format, vec![]))
        };
        for root in ["scene", "named", "scene/sparse/0", "scene/sparse"] {
            let root = of(root, Format::Colmap).unwrap();
            assert!(inside.iter().all(|name| root.check(&path(name)).is_ok()));
            for name in outside {
                let message = root.check(&path(name)).unwrap_err();
                assert!(message.contains("lies outside of") && message.contains("--allow-outside"), "{message}");
            }
            assert!(root.check(&path("scene/absent.png")).unwrap_err().contains("cannot be found"));
        }
        // A common prefix of names does not count.
        assert!(Root::new(&path("scene")).unwrap().check(&path("scene2/b.png")).is_err());
        // Only COLMAP models use the parent folder, and only for this folder name.
        assert!(of("scene/sparse", Format::Transforms).unwrap().check(&path("scene/a.png")).is_err());
        assert!(of("scene2", Format::Colmap).unwrap().check(&path("c.png")).is_err());
        assert!(of("absent", Format::Colmap).is_err());
    }
}

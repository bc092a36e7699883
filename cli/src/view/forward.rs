//! The page that `--open` shows first.

use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

use raygrad::nerf::{Error, Result};
use raygrad::nn::TEMPORARY_PREFIX;
use tempfile::{Builder, NamedTempFile};

/// After this time the browser has read the page, or never will.
const OLD: Duration = Duration::from_secs(120);

/// A local page that forwards to the viewer; removed when this is dropped.
///
/// All users of a machine can read the arguments of its programs, and the link gives access. So the browser is started
/// with this page instead, which its owner alone can read.
pub struct ForwardPage {
    file: NamedTempFile,
    written: Instant,
}

impl ForwardPage {
    /// Writes the page and opens it in the browser.
    ///
    /// The page is in `folder` if that is writable, since confined browsers see no folder for temporary files.
    ///
    /// # Errors
    ///
    /// Fails if the page cannot be written or no browser can be started.
    pub fn open(folder: &Path, link: &str) -> Result<Self> {
        let page = Self::write(folder, link).or_else(|_| Self::write(&std::env::temp_dir(), link))?;
        open::that_detached(page.file.path()).map_err(|e| Error::file(page.file.path(), e))?;
        Ok(page)
    }

    fn write(folder: &Path, link: &str) -> Result<Self> {
        let bad = |e: std::io::Error| Error::file(folder, format!("cannot hold the page that forwards: {e}"));
        // An absolute name, since the browser may start in another folder. `tempfile` lets the owner alone read it.
        let folder = std::path::absolute(folder).map_err(bad)?;
        let mut file = Builder::new().prefix(TEMPORARY_PREFIX).suffix(".html").tempfile_in(&folder).map_err(bad)?;
        let page = format!(
            "<!doctype html>\n<meta charset=\"utf-8\">\n<meta name=\"referrer\" content=\"no-referrer\">\n\
             <meta http-equiv=\"refresh\" content=\"0; url={link}\">\n<title>raygrad</title>\n\
             <a href=\"{link}\">Open the viewer</a>\n"
        );
        file.write_all(page.as_bytes()).map_err(bad)?;
        Ok(ForwardPage { file, written: Instant::now() })
    }

    /// Returns true if no browser will read the page any more.
    pub fn is_old(&self) -> bool {
        self.written.elapsed() > OLD
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn forward_page_is_private_and_temporary() {
        let folder = tempfile::tempdir().unwrap();
        let page = ForwardPage::write(folder.path(), "http://127.0.0.1:7/#token=abc").unwrap();
        let path = page.file.path().to_owned();
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(path.is_absolute() && text.contains("content=\"0; url=http://127.0.0.1:7/#token=abc\""), "{text}");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            assert_eq!(path.metadata().unwrap().permissions().mode() & 0o077, 0);
        }
        assert!(!page.is_old());
        drop(page);
        assert!(!path.exists());
        let error = ForwardPage::write(Path::new("absent"), "").err().unwrap().to_string();
        assert!(error.contains("absent") && error.contains("cannot hold the page"), "{error}");
    }
}

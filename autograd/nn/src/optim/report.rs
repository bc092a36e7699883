//! The result of an update.

use std::fmt;

/// The result of [`Optimizer::update`](crate::Optimizer::update), in elements of parameters.
///
/// An optimizer skips an element whose gradient is infinite or NaN. So a run survives a single overflow, but a diverged
/// run would stop silently. Look at the report in each step: [`check`](Self::check) fails if an element was skipped. A
/// run that should tolerate some can test [`has_only_non_finite`](Self::has_only_non_finite) over many steps.
#[must_use = "elements with a non-finite gradient are not updated: `check` is an error if there are any"]
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct UpdateReport {
    /// Number of updated elements. For a lazy parameter, those of the rows with a gradient.
    pub updated: usize,
    /// Number of skipped elements, whose gradient or new value is infinite or NaN.
    pub skipped: usize,
    /// The parameters with skipped elements, and the number of these.
    pub non_finite: Vec<(String, usize)>,
}

impl UpdateReport {
    /// Adds the numbers of one parameter.
    pub fn count(&mut self, name: &str, moved: usize, skipped: usize) {
        self.updated += moved;
        self.skipped += skipped;
        if skipped > 0 {
            self.non_finite.push((name.to_owned(), skipped));
        }
    }

    /// The number of updated elements.
    ///
    /// # Errors
    /// If elements were skipped.
    pub fn check(self) -> Result<usize, NonFinite> {
        if self.skipped == 0 { Ok(self.updated) } else { Err(NonFinite(self)) }
    }

    /// Whether every element with a gradient was skipped, and there were some. One such step may be an overflow. If
    /// every step is like this, the run has diverged.
    pub fn has_only_non_finite(&self) -> bool {
        self.updated == 0 && self.skipped > 0
    }
}

/// The error of an update with gradients that are infinite or NaN.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NonFinite(
    /// The result of the update.
    pub UpdateReport,
);

impl std::error::Error for NonFinite {}

impl fmt::Display for NonFinite {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let UpdateReport { updated: moved, skipped, non_finite: bad } = &self.0;
        let what = "elements were not updated, because the gradient or the new value is not finite:";
        write!(f, "{skipped} of {} {what}", moved + skipped)?;
        for (place, (name, count)) in bad.iter().enumerate() {
            write!(f, "{} {count} of `{name}`", if place > 0 { "," } else { "" })?;
        }
        f.write_str("; lower the learning rate or clip the gradients")
    }
}

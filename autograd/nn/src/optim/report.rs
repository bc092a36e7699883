//! What an update did.

use std::fmt;

/// What [`Optimizer::update`](crate::Optimizer::update) did, in elements of parameters.
///
/// An element whose gradient is infinite or NaN stays where it is. That saves a run from a single overflow, but a run
/// that has diverged would stand still without a word: so the report asks to be looked at. [`check`](Self::check) ends a
/// run at the first bad gradient; who wants to go on looks whether it [`has_only_non_finite`](Self::has_only_non_finite) for many steps.
#[must_use = "elements with a non-finite gradient are not updated: `check` is an error if there are any"]
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct UpdateReport {
    /// Elements that were moved. Of a lazy parameter those of the rows that got a gradient.
    pub moved: usize,
    /// Elements that were left alone, because their gradient or what would have come of it is infinite or NaN.
    pub skipped: usize,
    /// The parameters that these belong to, and how many they are.
    pub bad: Vec<(String, usize)>,
}

impl UpdateReport {
    /// Takes account of one parameter.
    pub fn count(&mut self, name: &str, moved: usize, skipped: usize) {
        self.moved += moved;
        self.skipped += skipped;
        if skipped > 0 {
            self.bad.push((name.to_owned(), skipped));
        }
    }

    /// How many elements were moved.
    ///
    /// # Errors
    /// If others were left alone.
    pub fn check(self) -> Result<usize, NonFinite> {
        if self.skipped == 0 { Ok(self.moved) } else { Err(NonFinite(self)) }
    }

    /// Whether there were gradients and none of them was of any use. Once in a while that is an overflow; at every step
    /// the run has diverged.
    pub fn has_only_non_finite(&self) -> bool {
        self.moved == 0 && self.skipped > 0
    }
}

/// Gradients that are infinite or NaN.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NonFinite(
    /// What the update did.
    pub UpdateReport,
);

impl std::error::Error for NonFinite {}

impl fmt::Display for NonFinite {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let UpdateReport { moved, skipped, bad } = &self.0;
        let what = "elements were not updated, because the gradient or the new value is not finite:";
        write!(f, "{skipped} of {} {what}", moved + skipped)?;
        for (place, (name, count)) in bad.iter().enumerate() {
            write!(f, "{} {count} of `{name}`", if place > 0 { "," } else { "" })?;
        }
        f.write_str("; lower the learning rate or clip the gradients")
    }
}

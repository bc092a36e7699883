//! Times on a machine that does other things too: what is compared runs in turns.

use std::time::Instant;

/// What comparing something with a baseline found.
#[derive(Debug, Clone, Copy)]
pub struct Timed {
    /// Seconds of a run: the median.
    pub seconds: f64,
    /// Seconds of a run of the baseline: the median.
    pub baseline: f64,
    /// How many times as long it takes as the baseline: the median over the rounds.
    pub ratio: f64,
    /// The same for the baseline and itself: the median of the control.
    pub control: f64,
    /// The distance between the quartiles of the control: ratios that differ by less are the same.
    pub spread: f64,
}

/// Runs `a` (the baseline) and `b` in the order A B B A, `rounds` times after one that does not count. The control is the
/// ratio of the two runs of A in a round.
pub fn compare(rounds: usize, mut a: impl FnMut(), mut b: impl FnMut()) -> Timed {
    let time = |f: &mut dyn FnMut()| {
        let start = Instant::now();
        f();
        start.elapsed().as_secs_f64()
    };
    a();
    b();
    let rounds: Vec<[f64; 4]> =
        (0..rounds.max(1)).map(|_| [time(&mut a), time(&mut b), time(&mut b), time(&mut a)]).collect();
    let quantile_of = |q: f64, f: &dyn Fn(&[f64; 4]) -> f64| quantile(q, rounds.iter().map(f).collect());
    let control = |r: &[f64; 4]| r[3] / r[0];
    Timed {
        seconds: quantile(0.5, rounds.iter().flat_map(|r| [r[1], r[2]]).collect()),
        baseline: quantile(0.5, rounds.iter().flat_map(|r| [r[0], r[3]]).collect()),
        ratio: quantile_of(0.5, &|r| (r[1] + r[2]) / (r[0] + r[3])),
        control: quantile_of(0.5, &control),
        spread: quantile_of(0.75, &control) - quantile_of(0.25, &control),
    }
}

/// The value below which a share `q` of the values lies, interpolated.
pub fn quantile(q: f64, mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let place = q * (values.len() - 1) as f64;
    let below = place.floor() as usize;
    let above = (below + 1).min(values.len() - 1);
    values[below] + (place - below as f64) * (values[above] - values[below])
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::RefCell;

    #[test]
    fn runs_take_turns() {
        let order = RefCell::new(String::new());
        let timed = compare(2, || order.borrow_mut().push('a'), || order.borrow_mut().push('b'));
        assert_eq!(*order.borrow(), "ababbaabba");
        assert!(timed.ratio > 0.0 && timed.control > 0.0 && timed.spread >= 0.0 && timed.seconds >= 0.0);
    }

    #[test]
    fn quantiles_are_interpolated() {
        assert_eq!(quantile(0.5, vec![3.0, 1.0, 2.0]), 2.0);
        assert_eq!(quantile(0.25, vec![1.0, 2.0, 3.0, 5.0]), 1.75);
        assert_eq!(quantile(0.5, vec![7.0]), 7.0);
    }
}

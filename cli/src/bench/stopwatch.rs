//! Interleaved timing for machines with other load.

use std::time::Instant;

/// Timing of a function relative to a baseline.
#[derive(Debug, Clone, Copy)]
pub struct Timed {
    /// Median time of a run, in seconds.
    pub seconds: f64,
    /// Median time of a run of the baseline, in seconds.
    pub baseline: f64,
    /// Time relative to the baseline: the median over the rounds.
    pub ratio: f64,
    /// Time of the baseline relative to itself: the median of the control.
    pub control: f64,
    /// Interquartile range of the control. Ratios that differ by less are equal.
    pub spread: f64,
}

/// Runs `a` (the baseline) and `b` in the order A B B A, `rounds` times after one warm-up round. The control is the
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

/// The `q`-quantile of the values, interpolated.
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
    fn compare_runs_in_abba_order() {
        let order = RefCell::new(String::new());
        let timed = compare(2, || order.borrow_mut().push('a'), || order.borrow_mut().push('b'));
        assert_eq!(*order.borrow(), "ababbaabba");
        assert!(timed.ratio > 0.0 && timed.control > 0.0 && timed.spread >= 0.0 && timed.seconds >= 0.0);
    }

    #[test]
    fn quantile_between_values_interpolates() {
        assert_eq!(quantile(0.5, vec![3.0, 1.0, 2.0]), 2.0);
        assert_eq!(quantile(0.25, vec![1.0, 2.0, 3.0, 5.0]), 1.75);
        assert_eq!(quantile(0.5, vec![7.0]), 7.0);
    }
}

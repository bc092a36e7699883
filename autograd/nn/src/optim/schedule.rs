//! Learning-rate schedules.

use super::SettingError;
use super::settings::{check, check_rate};
use serde::{Deserialize, Serialize};

/// A learning-rate schedule: the learning rate as a function of the completed fraction of the budget (steps, time or
/// samples). So one schedule fits short and long runs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Schedule {
    /// A constant learning rate.
    Constant {
        /// Learning rate. Range: 0 to 1e30.
        #[serde(alias = "rate")]
        lr: f64,
    },
    /// Linear: `from + (to - from) fraction`, after a linear warm-up from 0. With `to` equal to `from` it is constant
    /// after the warm-up.
    Linear {
        /// Learning rate at the start. Range: 0 to 1e30.
        from: f64,
        /// Learning rate at the end. Range: 0 to 1e30.
        to: f64,
        /// Fraction of the run for the warm-up, over which the rate rises from 0. Range: 0 to 1.
        warmup: f64,
    },
    /// A staircase: `from * factor^k` after `k` times `every` of the run, after a linear warm-up from 0.
    Step {
        /// Learning rate at the start. Range: 0 to 1e30.
        from: f64,
        /// Factor of each stair. Range: 0 to 1.
        factor: f64,
        /// Fraction of the run that a stair takes. Range: more than 0, to 1.
        every: f64,
        /// Fraction of the run for the warm-up, over which the rate rises from 0. Range: 0 to 1.
        warmup: f64,
    },
    /// Exponential decay: `from * (to / from)^fraction`, after a linear warm-up from 0.
    Exponential {
        /// Learning rate at the start. Range: 1e-30 to 1e30.
        from: f64,
        /// Learning rate at the end. Range: 1e-30 to 1e30.
        to: f64,
        /// Fraction of the run for the warm-up, over which the rate rises from 0. Range: 0 to 1.
        warmup: f64,
    },
    /// Cosine annealing: half a cosine wave from `from` to `to`, after a linear warm-up from 0 (Loshchilov and Hutter
    /// 2017, equation 5, one period).
    Cosine {
        /// Learning rate at the start. Range: 0 to 1e30.
        from: f64,
        /// Learning rate at the end. Range: 0 to 1e30.
        to: f64,
        /// Fraction of the run for the warm-up, over which the rate rises from 0. Range: 0 to 1.
        warmup: f64,
    },
}

impl Schedule {
    /// The name of the kind, as in configuration files.
    pub fn name(&self) -> &'static str {
        match self {
            Schedule::Constant { .. } => "constant",
            Schedule::Linear { .. } => "linear",
            Schedule::Step { .. } => "step",
            Schedule::Exponential { .. } => "exponential",
            Schedule::Cosine { .. } => "cosine",
        }
    }

    /// The learning rate after `fraction` (0 to 1) of the run. The warm-up multiplies the rate, so it does not delay
    /// the rest of the schedule.
    pub fn lr(&self, fraction: f64) -> f64 {
        let fraction = fraction.clamp(0.0, 1.0);
        let rise = |warmup: f64| if fraction < warmup { fraction / warmup } else { 1.0 };
        match *self {
            Schedule::Constant { lr } => lr,
            Schedule::Linear { from, to, warmup } => rise(warmup) * between([from, to], [1.0 - fraction, fraction]),
            Schedule::Step { from, factor, every, warmup } => {
                // A fraction such as 0.3 is some roundings less than three times 0.1.
                let stairs = (fraction / every * (1.0 + 2.0 * f64::EPSILON)).floor().min(f64::MAX);
                // A power that underflows, where the rate may not, is two factors.
                let (power, half) = (factor.powf(stairs), (0.5 * stairs).floor());
                match power >= f64::MIN_POSITIVE {
                    true => rise(warmup) * from * power,
                    false => rise(warmup) * from * factor.powf(half) * factor.powf(stairs - half),
                }
            }
            // Scaled by 0.
            Schedule::Exponential { from: 0.0, .. } => 0.0,
            Schedule::Exponential { from, to, warmup } => rise(warmup) * from * (to / from).powf(fraction),
            Schedule::Cosine { from, to, warmup } => {
                let half = |share: f64| (std::f64::consts::FRAC_PI_2 * share).sin().powi(2);
                rise(warmup) * between([from, to], [half(1.0 - fraction), half(fraction)])
            }
        }
    }

    /// The schedule with its learning rates times `factor`.
    pub fn scaled(mut self, factor: f64) -> Self {
        match &mut self {
            Schedule::Constant { lr } | Schedule::Step { from: lr, .. } => *lr *= factor,
            Schedule::Linear { from, to, .. }
            | Schedule::Exponential { from, to, .. }
            | Schedule::Cosine { from, to, .. } => (*from, *to) = (*from * factor, *to * factor),
        }
        self
    }

    /// Checks that the numbers are in their ranges. Rates are 0 to 1e30, which leaves f32 room for multiples, and at
    /// least 1e-30 in [`Exponential`](Self::Exponential). Fractions of the run are 0 to 1, and `every` is more than 0.
    ///
    /// # Errors
    /// If a number is not in its range. The error has its name.
    pub fn check(&self) -> Result<(), SettingError> {
        let check_warmup = |warmup| check("warmup", warmup, (0.0..=1.0).contains(&warmup), "0 to 1");
        let check_ratio = |name, rate| check(name, rate, (1e-30..=1e30).contains(&rate), "1e-30 to 1e30");
        match *self {
            Schedule::Constant { lr } => check_rate("lr", lr),
            Schedule::Linear { from, to, warmup } | Schedule::Cosine { from, to, warmup } => {
                check_rate("from", from)?;
                check_rate("to", to)?;
                check_warmup(warmup)
            }
            Schedule::Step { from, factor, every, warmup } => {
                check_rate("from", from)?;
                check("factor", factor, (0.0..=1.0).contains(&factor), "0 to 1")?;
                check("every", every, every > 0.0 && every <= 1.0, "more than 0, to 1")?;
                check_warmup(warmup)
            }
            Schedule::Exponential { from, to, warmup } => {
                check_ratio("from", from)?;
                check_ratio("to", to)?;
                check_warmup(warmup)
            }
        }
    }

    /// The learning rate of step `step`, counted from 0, of `steps`. It is that of the middle of the step, so that a
    /// warm-up does not start with a rate of 0.
    pub fn at_step(&self, step: u64, steps: u64) -> f64 {
        self.lr((step as f64 + 0.5) / steps.max(1) as f64)
    }
}

/// The mean of two rates whose weights add up to 1. It starts at the rate of the larger weight: so it is exact at both
/// ends and for equal rates, and a small rate keeps its digits beside a large one.
fn between(rates: [f64; 2], weights: [f64; 2]) -> f64 {
    let near = usize::from(weights[1] > weights[0]);
    rates[near] + (rates[1 - near] - rates[near]) * weights[1 - near]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn assert_rates(schedule: Schedule, rates: &[(f64, f64)]) {
        for &(fraction, rate) in rates {
            let got = schedule.lr(fraction);
            assert!((got - rate).abs() < 1e-15, "{schedule:?} at {fraction}: {got} instead of {rate}");
        }
    }

    #[test]
    fn scaled_schedules_scale_at_every_point() {
        for schedule in [
            Schedule::Constant { lr: 0.3 },
            Schedule::Linear { from: 1.0, to: 0.2, warmup: 0.5 },
            Schedule::Step { from: 0.8, factor: 0.5, every: 0.25, warmup: 0.5 },
            Schedule::Exponential { from: 1e-2, to: 1e-4, warmup: 0.1 },
            Schedule::Cosine { from: 1.0, to: 0.1, warmup: 0.0 },
        ] {
            let points = [0.0, 0.1, 0.3, 0.7, 1.0].map(|fraction| (fraction, 3.0 * schedule.lr(fraction)));
            assert_rates(schedule.scaled(3.0), &points);
            assert_eq!(schedule.scaled(1.0), schedule);
            assert_rates(schedule.scaled(0.0), &points.map(|(fraction, _)| (fraction, 0.0)));
        }
    }

    #[test]
    fn a_stair_rises_first() {
        let stair = Schedule::Step { from: 0.8, factor: 0.5, every: 0.25, warmup: 0.5 };
        assert_rates(stair, &[(0.0, 0.0), (0.125, 0.2), (0.25, 0.2), (0.5, 0.2), (0.75, 0.1)]);
    }

    #[test]
    fn schedules_hit_their_ends() {
        let decay = Schedule::Exponential { from: 1e-2, to: 1e-4, warmup: 0.1 };
        assert_eq!(decay.lr(0.0), 0.0);
        assert!((decay.lr(0.5) - 1e-3).abs() < 1e-12);
        assert!((decay.lr(1.0) - 1e-4).abs() < 1e-12 && decay.lr(2.0) == decay.lr(1.0));
    }

    #[test]
    fn every_form_passes_its_points() {
        assert_rates(Schedule::Constant { lr: 0.3 }, &[(-1.0, 0.3), (0.0, 0.3), (1.0, 0.3)]);
        let linear = Schedule::Linear { from: 1.0, to: 0.2, warmup: 0.5 };
        assert_rates(linear, &[(0.0, 0.0), (0.25, 0.5 * 0.8), (0.5, 0.6), (1.0, 0.2), (7.0, 0.2)]);
        let flat = Schedule::Linear { from: 0.4, to: 0.4, warmup: 0.1 };
        assert_rates(flat, &[(0.05, 0.2), (0.1, 0.4), (0.7, 0.4)]);
        let cosine = Schedule::Cosine { from: 1.0, to: 0.1, warmup: 0.0 };
        assert_rates(cosine, &[(0.0, 1.0), (1.0 / 3.0, 0.1 + 0.9 * 0.75), (0.5, 0.55), (1.0, 0.1)]);
        assert_rates(Schedule::Cosine { from: 1.0, to: 0.0, warmup: 0.5 }, &[(0.25, 0.5 * (0.5 + 0.125_f64.sqrt()))]);
        let step = Schedule::Step { from: 1.0, factor: 0.5, every: 0.1, warmup: 0.0 };
        for stair in 0..=10 {
            let rate = 0.5_f64.powi(stair);
            assert_rates(step, &[(f64::from(stair) / 10.0, rate), (0.1 * f64::from(stair), rate)]);
            assert_rates(step, &[(0.0999 + 0.1 * f64::from(stair), rate)]);
        }
    }

    #[test]
    fn numbers_out_of_range_are_named() {
        let good = [
            Schedule::Constant { lr: 0.0 },
            Schedule::Linear { from: 1.0, to: 0.0, warmup: 1.0 },
            Schedule::Cosine { from: 0.0, to: 2.0, warmup: 0.0 },
            Schedule::Step { from: 1.0, factor: 1.0, every: 1.0, warmup: 0.5 },
            Schedule::Exponential { from: 1e-3, to: 1e-30, warmup: 0.0 },
        ];
        assert!(good.iter().all(|schedule| schedule.check().is_ok()));
        for (schedule, expected) in [
            (Schedule::Constant { lr: 1e300 }, "`lr` is 1e300; use 0 to 1e30"),
            (Schedule::Constant { lr: f64::NAN }, "`lr` is NaN; use 0 to 1e30"),
            (Schedule::Linear { from: -1.0, to: 0.0, warmup: 0.0 }, "`from` is -1.0; use 0 to 1e30"),
            (Schedule::Cosine { from: 1.0, to: f64::INFINITY, warmup: 0.0 }, "`to` is inf; use 0 to 1e30"),
            (Schedule::Linear { from: 1.0, to: 0.0, warmup: 1.5 }, "`warmup` is 1.5; use 0 to 1"),
            (Schedule::Exponential { from: 1.0, to: 0.0, warmup: 0.0 }, "`to` is 0.0; use 1e-30 to 1e30"),
            (Schedule::Exponential { from: 0.0, to: 1.0, warmup: 0.0 }, "`from` is 0.0; use 1e-30 to 1e30"),
            (Schedule::Step { from: 1.0, factor: 2.0, every: 0.1, warmup: 0.0 }, "`factor` is 2.0; use 0 to 1"),
            (
                Schedule::Step { from: 1.0, factor: 0.5, every: 0.0, warmup: 0.0 },
                "`every` is 0.0; use more than 0, to 1",
            ),
        ] {
            let message = schedule.check().map_err(|error| error.to_string());
            assert!(message.as_ref().is_err_and(|message| message.contains(expected)), "{message:?} and {expected}");
        }
    }

    #[test]
    fn the_first_step_of_a_warmup_is_not_lost() {
        let schedule = Schedule::Linear { from: 1.0, to: 1.0, warmup: 0.1 };
        let rates: Vec<_> = (0..100).map(|step| schedule.at_step(step, 100)).collect();
        assert!((rates[0] - 0.05).abs() < 1e-15 && (rates[9] - 0.95).abs() < 1e-15 && rates[10] == 1.0);
        assert_eq!(schedule.at_step(0, 0), 1.0);
    }
}

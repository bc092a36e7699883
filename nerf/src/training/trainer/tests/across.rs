//! Steps that are shared between processes, which are threads here.

use super::*;
use crate::SceneBox;
use raygrad_nn::{Exchange, ExchangeError, InProcess};

/// Runs a trainer on each of several ranks, and returns what `run` makes of it.
fn on_ranks<R: Send>(
    ranks: usize,
    trainer: impl Fn(usize) -> Trainer + Sync,
    run: impl Fn(usize, Trainer) -> R + Sync,
) -> Vec<R> {
    let exchanges = InProcess::ranks(ranks).into_iter();
    std::thread::scope(|scope| {
        let start = |exchange: InProcess| {
            let (trainer, run) = (&trainer, &run);
            scope.spawn(move || {
                let rank = exchange.rank();
                let mut trainer = trainer(rank);
                trainer.share(Box::new(exchange)).unwrap();
                trainer.exchange_mut().unwrap().set_timeout(Duration::from_secs(60));
                run(rank, trainer)
            })
        };
        let threads: Vec<_> = exchanges.map(start).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    })
}

fn trainer(config: Config) -> Trainer {
    Trainer::new(config, Arc::new(ball(Split::Train, 12))).unwrap()
}

/// With steps of 13 tiles, in which the number of rays grows at first.
fn many_tiles() -> Config {
    let mut config = tiny_table();
    let sampler = config.sampler.get_mut::<MarchingConfig>().unwrap();
    (sampler.samples, sampler.tiles) = (16_000, 13);
    config
}

/// The state without times, which differ.
fn state(mut trainer: Trainer) -> Vec<u8> {
    (trainer.elapsed, trainer.done.train_seconds) = (Duration::ZERO, 0.0);
    trainer.state().unwrap()
}

#[test]
fn shared_steps_have_the_bits_of_one_process() {
    // The third grid has several tasks, which ranks share; its updates come at steps 17 and 33.
    let mut large_grid = tiny_table();
    large_grid.sampler.get_mut::<MarchingConfig>().unwrap().occupancy.resolution = 32;
    let refined = tiny_table().with_refined(&[RefinedParam::Poses, RefinedParam::Exposure]);
    let steps = [(tiny(), 12), (tiny_table(), 12), (large_grid, 36), (refined, 12), (many_tiles(), 6)];
    for (config, steps) in steps {
        let run = |_: usize, mut trainer: Trainer| {
            trainer.run(Budget::Steps(steps), |_| ControlFlow::Continue(()));
            assert_eq!(trainer.exchange_error(), None);
            state(trainer)
        };
        let alone = run(0, trainer(config.clone()));
        for ranks in [2, 3] {
            let all = on_ranks(ranks, |_| trainer(config.clone()), run);
            assert!(all.iter().all(|state| *state == alone), "{ranks} ranks");
        }
    }
}

#[test]
fn checkpoint_of_two_ranks_resumes_on_three() {
    let steps = |from: u64, to: u64| {
        move |trainer: &mut Trainer| {
            for step in from..to {
                trainer.step(step as f64 / 12.0);
            }
        }
    };
    let mut alone = trainer(many_tiles());
    steps(0, 12)(&mut alone);
    let half = on_ranks(
        2,
        |_| trainer(many_tiles()),
        |_, mut trainer| {
            steps(0, 6)(&mut trainer);
            assert!(trainer.batch > 500 && trainer.draw(0.5).tiles() == 13);
            trainer.state().unwrap()
        },
    );
    let resumed = |_| {
        let mut trainer = trainer(many_tiles());
        trainer.load_state(&half[0]).unwrap();
        trainer
    };
    let all = on_ranks(3, resumed, |_, mut trainer| {
        steps(6, 12)(&mut trainer);
        state(trainer)
    });
    let alone = state(alone);
    assert!(all.iter().all(|state| *state == alone));
}

#[test]
fn rank_0_counts_the_time_and_any_rank_stops_all() {
    // The clocks differ: that of rank 0 counts a second at each look, the other stands.
    let timed = |rank: usize| {
        let data = Arc::new(ball(Split::Train, 12));
        let extent = SceneBox::new(data.bounds, [data.near, data.far]);
        let seconds = AtomicU64::new(0);
        let clock = move || match rank {
            0 => Duration::from_secs(seconds.fetch_add(1, Relaxed)),
            _ => Duration::ZERO,
        };
        Trainer::with_clock(tiny_table(), data, extent, clock).unwrap()
    };
    let ended = on_ranks(2, timed, |_, mut trainer| {
        trainer.run(Budget::Time(Duration::from_secs(10)), |_| ControlFlow::Continue(()));
        trainer.stats().step
    });
    assert!(ended[0] == ended[1] && (5..20).contains(&ended[0]), "{ended:?}");
    let ended = on_ranks(
        3,
        |_| trainer(tiny_table()),
        |rank, mut trainer| {
            trainer.run(Budget::Steps(50), |trainer| match (rank, trainer.stats().step) {
                (1, 4) => ControlFlow::Break(()),
                _ => ControlFlow::Continue(()),
            });
            (trainer.stats().step, trainer.exchange_error().is_none())
        },
    );
    assert_eq!(ended, [(4, true); 3]);
}

#[test]
fn lost_ranks_end_the_run_with_their_number() {
    let ended = on_ranks(
        3,
        |_| trainer(tiny_table()),
        |rank, mut trainer| {
            for step in 0..5 {
                trainer.step(f64::from(step) / 20.0);
            }
            if rank == 2 {
                return (0, String::new());
            }
            let before = trainer.stats().step;
            trainer.run(Budget::Steps(20), |_| ControlFlow::Continue(()));
            assert_eq!(trainer.stats().step, before);
            let error = trainer.exchange_error().unwrap().to_string();
            assert!(trainer.step(0.5).step == before, "a step without the others");
            (before, error)
        },
    );
    for (step, error) in &ended[..2] {
        assert!(*step == 5 && error.starts_with("rank "), "{error}");
    }
    assert!(ended.iter().any(|(_, error)| error.starts_with("rank 2 has ended")), "{ended:?}");
}

/// An exchange that fails at a call, counted from 0.
struct Failing(InProcess, usize);

impl Exchange for Failing {
    fn rank(&self) -> usize {
        self.0.rank()
    }
    fn ranks(&self) -> usize {
        self.0.ranks()
    }
    fn all_to_all(&mut self, parts: &[&[u8]]) -> std::result::Result<Vec<Vec<u8>>, ExchangeError> {
        if self.1 == 0 {
            return Err(ExchangeError::Connection("unplugged".into()));
        }
        self.1 -= 1;
        self.0.all_to_all(parts)
    }
    fn set_timeout(&mut self, timeout: Duration) {
        self.0.set_timeout(timeout);
    }
    fn sent_bytes(&self) -> u64 {
        self.0.sent_bytes()
    }
}

#[test]
fn failure_of_any_exchange_keeps_parameters_and_statistics() {
    // A step has two exchanges, and step 17 one more for the grid. The first one checks the start.
    let calls = 1 + 2 * 16;
    let run = |exchange: InProcess, fails_at: usize| {
        let mut trainer = trainer(tiny_table());
        trainer.share(Box::new(Failing(exchange, fails_at))).unwrap();
        let mut last = None;
        trainer.run(Budget::Steps(50), |trainer| {
            last = Some((trainer.model.params.clone(), trainer.stats().step));
            ControlFlow::Continue(())
        });
        let (params, step) = last.unwrap();
        assert_eq!(trainer.exchange_error(), Some(&ExchangeError::Connection("unplugged".into())));
        assert_eq!((trainer.stats().step, step), (16, 16), "{fails_at}");
        assert!(trainer.model.params.values().iter().zip(params.values()).all(|(a, b)| a == b));
        // No step is made alone.
        assert_eq!(trainer.step(0.5).step, 16);
    };
    for fails_at in [calls, calls + 1, calls + 2] {
        std::thread::scope(|scope| {
            let start = |exchange| scope.spawn(move || run(exchange, fails_at));
            let ranks: Vec<_> = InProcess::ranks(2).into_iter().map(start).collect();
            ranks.into_iter().for_each(|rank| rank.join().unwrap());
        });
    }
}

#[test]
fn ranks_that_drift_apart_end_the_run() {
    let ended = on_ranks(
        2,
        |_| trainer(tiny_table()),
        |rank, mut trainer| {
            trainer.run(Budget::Steps(100), |_| ControlFlow::Continue(()));
            if rank == 1 {
                let id = trainer.model.params.ids().next().unwrap();
                let value = trainer.model.params.get_mut(id).as_mut_slice();
                value[0] = value[0].next_up();
            }
            trainer.run(Budget::Steps(400), |_| ControlFlow::Continue(()));
            (trainer.stats().step, trainer.exchange_error().unwrap().to_string())
        },
    );
    for (rank, (step, error)) in ended.into_iter().enumerate() {
        let expected = format!("rank {} has other parameters at step 256", 1 - rank);
        assert!(step == 256 && error.starts_with(&expected), "{step} {error}");
    }
}

#[test]
fn ranks_that_differ_are_refused_by_what_differs() {
    type Change = fn(Config, Dataset) -> Trainer;
    let refused = |change: Change| {
        let ranks: Vec<_> = InProcess::ranks(3)
            .into_iter()
            .map(|exchange| {
                std::thread::spawn(move || {
                    let (data, config) = (ball(Split::Train, 12), tiny_table());
                    let mut trainer = match exchange.rank() {
                        1 => change(config, data),
                        _ => Trainer::new(config, Arc::new(data)).unwrap(),
                    };
                    let error = trainer.share(Box::new(exchange)).unwrap_err().to_string();
                    assert!(trainer.exchange_mut().is_none());
                    error
                })
            })
            .collect();
        let errors: Vec<String> = ranks.into_iter().map(|rank| rank.join().unwrap()).collect();
        assert!(errors.iter().all(|error| *error == errors[0]), "{errors:?}");
        errors[0].clone()
    };
    let cases: [(Change, &str); 5] = [
        (|config, data| Trainer::new(Config { seed: 1, ..config }, Arc::new(data)).unwrap(), "another configuration"),
        (
            |config, mut data| {
                data.frames[3].camera.pose.translation.x += 1e-9;
                Trainer::new(config, Arc::new(data)).unwrap()
            },
            "other images or cameras",
        ),
        (
            |config, mut data| {
                let mut image = data.frames[59].image.to_image();
                image.data[7] = 1.0 - image.data[7];
                data.frames[59].image = image.into();
                Trainer::new(config, Arc::new(data)).unwrap()
            },
            "other images or cameras",
        ),
        (
            |config, data| {
                let mut trainer = Trainer::new(config, Arc::new(data)).unwrap();
                trainer.step(0.0);
                trainer
            },
            "another step",
        ),
        (
            |config, data| {
                let mut trainer = Trainer::new(config, Arc::new(data)).unwrap();
                let id = trainer.model.params.ids().next().unwrap();
                trainer.model.params.get_mut(id).as_mut_slice()[0] += 1.0;
                trainer
            },
            "other parameters",
        ),
    ];
    for (change, expected) in cases {
        let error = refused(change);
        assert!(error.contains(&format!("rank 1 has {expected}")), "{error}");
    }
}

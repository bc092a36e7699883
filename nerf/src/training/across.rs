//! What processes that train one model tell each other, beside gradients.

use super::stats::Budget;
use crate::dataset::Dataset;
use crate::model::Model;
use crate::{Error, Result};
use raygrad_autograd::Scalar;
use raygrad_nn::{Exchange, ExchangeError, Params};
use raygrad_tensor::simd;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::time::Duration;

/// The other processes that train the same model.
pub(super) struct Across {
    pub exchange: Box<dyn Exchange>,
    /// The reason that they cannot work together any more.
    pub error: Option<ExchangeError>,
    /// Whether this process asks all of them to stop.
    pub stops: bool,
}

/// What must be the same in all processes before the first step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Start {
    version: String,
    /// The instruction set, on which the last bits of matrix products depend.
    instructions: String,
    configuration: String,
    images: u64,
    parameters: u64,
    /// The step, and the rays of the next one.
    place: (u64, usize),
}

impl Start {
    fn new(model: &Model<f32>, state: &[u8], data: &Dataset, place: (u64, usize)) -> Result<Self> {
        let mut images = DefaultHasher::new();
        for frame in &data.frames {
            frame.name.hash(&mut images);
            images.write(&json(&frame.camera)?);
            frame.image.hash_values(&mut images);
            frame.mask.hash(&mut images);
            frame.distances.iter().flat_map(|image| &image.data).for_each(|x| images.write_u32(x.to_bits()));
        }
        let (images, parameters) = (images.finish(), hash_of(&model.params, state));
        let configuration = String::from_utf8_lossy(&json(&(&model.config, model.scene_box))?).into_owned();
        let (version, instructions) = (env!("CARGO_PKG_VERSION").to_owned(), simd::name().to_owned());
        Ok(Start { version, instructions, configuration, images, parameters, place })
    }

    /// What differs from another process.
    fn difference(&self, other: &Start) -> Option<&'static str> {
        let differ = [
            (self.version != other.version, "another version of raygrad"),
            (self.instructions != other.instructions, "other vector instructions: set RAYGRAD_SIMD alike on all ranks"),
            (self.configuration != other.configuration, "another configuration or scene box"),
            (self.images != other.images, "other images or cameras: all ranks must read the same capture"),
            (self.place != other.place, "another step: load the same state on all ranks"),
            (
                self.parameters != other.parameters,
                "other parameters or optimizer state: load the same state on all ranks",
            ),
        ];
        differ.into_iter().find(|(differs, _)| *differs).map(|(_, what)| what)
    }
}

/// Steps between comparisons of the parameters.
const COMPARED: u64 = 256;

/// What processes tell each other before each step.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Turn {
    step: u64,
    /// The budget and the lr scale, which set the learning rates.
    rates: (Budget, f64),
    elapsed: Duration,
    stops: bool,
    /// A hash of the parameters, in some steps.
    parameters: Option<u64>,
}

fn hash_of(params: &Params<f32>, more: &[u8]) -> u64 {
    let mut hasher = DefaultHasher::new();
    hasher.write(more);
    for (name, value) in params.iter() {
        name.hash(&mut hasher);
        value.as_slice().iter().for_each(|x| hasher.write_u32(x.to_bits()));
    }
    hasher.finish()
}

fn json(value: &impl Serialize) -> Result<Vec<u8>> {
    serde_json::to_vec(value).map_err(|error| Error::setting("exchange", error))
}

/// The values of all ranks.
fn gather<T: Serialize + DeserializeOwned>(
    exchange: &mut dyn Exchange,
    own: &T,
) -> std::result::Result<Vec<T>, ExchangeError> {
    let own = serde_json::to_vec(own).map_err(|error| ExchangeError::Connection(error.to_string()))?;
    let read = |(rank, message): (usize, &Vec<u8>)| {
        let what = "has sent a message that cannot be read; start all ranks with the same program";
        serde_json::from_slice(message).map_err(|_| ExchangeError::Differs { rank, what: what.into() })
    };
    exchange.all_gather(&own)?.iter().enumerate().map(read).collect()
}

impl Across {
    /// Checks that all processes have the same model and images, and the same state besides. `place` is the step, and the
    /// rays of the next one.
    pub fn new(
        mut exchange: Box<dyn Exchange>,
        (model, state): (&Model<f32>, &[u8]),
        data: &Dataset,
        place: (u64, usize),
    ) -> Result<Self> {
        let own = Start::new(model, state, data, place)?;
        let starts = gather(&mut *exchange, &own).and_then(|starts| {
            let differing = |(rank, start): (usize, &Start)| Some((rank, start.difference(&starts[0])?));
            match starts.iter().enumerate().find_map(differing) {
                Some((rank, what)) => Err(ExchangeError::Differs { rank, what: format!("has {what}") }),
                None => Ok(()),
            }
        });
        starts.map_err(|error| Error::setting("exchange", error))?;
        Ok(Across { exchange, error: None, stops: false })
    }

    /// The numbers of all ranks, by rank. `None` after an error.
    ///
    /// # Errors
    /// If a rank has sent another number of numbers than `counts` says.
    pub fn gather(&mut self, own: &[f32], counts: &[usize]) -> Option<Vec<Vec<f32>>> {
        let mut bytes = vec![];
        f32::write_le(own, &mut bytes);
        let all = self.exchange.all_gather(&bytes).and_then(|all| {
            let all: Vec<Vec<f32>> = all.iter().map(|bytes| f32::read_le(bytes)).collect();
            match (0..).zip(&all).zip(counts).find(|((_, found), count)| found.len() != **count) {
                Some(((rank, found), count)) => {
                    let what = format!("has sent the densities of {} cells, and {count} were due", found.len());
                    Err(ExchangeError::Differs { rank, what })
                }
                None => Ok(all),
            }
        });
        self.kept(all)
    }

    /// The result, or `None` after an error, which is kept.
    fn kept<R>(&mut self, result: std::result::Result<R, ExchangeError>) -> Option<R> {
        result.map_err(|error| self.error = Some(error)).ok()
    }

    /// Begins a step: returns the training time by the clock of rank 0, or `None` at the end of the run.
    pub fn begin(
        &mut self,
        (step, elapsed): (u64, Duration),
        rates: (Budget, f64),
        params: &Params<f32>,
    ) -> Option<Duration> {
        if self.error.is_some() {
            return None;
        }
        let parameters = step.is_multiple_of(COMPARED).then(|| hash_of(params, &[]));
        let own = Turn { step, rates, elapsed, stops: std::mem::take(&mut self.stops), parameters };
        let differs = |(rank, turn): (usize, &Turn)| {
            let what = if turn.step != step {
                format!("is at step {}, and this rank at step {step}", turn.step)
            } else if turn.rates != rates {
                "has another budget or lr scale: use the same on all ranks".to_owned()
            } else if turn.parameters != parameters {
                format!("has other parameters at step {step}: use the same processor and program on all ranks")
            } else {
                return None;
            };
            Some(ExchangeError::Differs { rank, what })
        };
        let turns = gather(&mut *self.exchange, &own).and_then(|turns| {
            let difference = turns.iter().enumerate().find_map(differs);
            difference.map_or(Ok(turns), Err)
        });
        let turns = self.kept(turns)?;
        (!turns.iter().any(|turn| turn.stops)).then_some(turns[0].elapsed)
    }
}

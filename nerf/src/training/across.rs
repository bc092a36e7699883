//! What processes that train one model tell each other, beside gradients.

use crate::dataset::Dataset;
use crate::model::Model;
use crate::{Error, Result};
use raygrad_autograd::Scalar;
use raygrad_nn::{Exchange, ExchangeError};
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
    configuration: String,
    images: u64,
    parameters: u64,
    /// The step, and the rays of the next one.
    place: (u64, usize),
}

impl Start {
    fn new(model: &Model<f32>, data: &Dataset, place: (u64, usize)) -> Result<Self> {
        let mut images = DefaultHasher::new();
        for frame in &data.frames {
            frame.name.hash(&mut images);
            images.write(&json(&frame.camera)?);
            frame.image.hash_values(&mut images);
            frame.mask.hash(&mut images);
            frame.distances.iter().flat_map(|image| &image.data).for_each(|x| images.write_u32(x.to_bits()));
        }
        let mut parameters = DefaultHasher::new();
        for (name, value) in model.params.iter() {
            name.hash(&mut parameters);
            value.as_slice().iter().for_each(|x| parameters.write_u32(x.to_bits()));
        }
        let [images, parameters] = [images, parameters].map(|hasher| hasher.finish());
        let configuration = String::from_utf8_lossy(&json(&(&model.config, model.scene_box))?).into_owned();
        Ok(Start { version: env!("CARGO_PKG_VERSION").into(), configuration, images, parameters, place })
    }

    /// What differs from another process.
    fn difference(&self, other: &Start) -> Option<&'static str> {
        let differ = [
            (self.version != other.version, "another version of raygrad"),
            (self.configuration != other.configuration, "another configuration or scene box"),
            (self.images != other.images, "other images or cameras: all ranks must read the same capture"),
            (self.place != other.place, "another step: load the same state on all ranks"),
            (self.parameters != other.parameters, "other parameters: load the same state on all ranks"),
        ];
        differ.into_iter().find(|(differs, _)| *differs).map(|(_, what)| what)
    }
}

/// What processes tell each other before each step.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Turn {
    step: u64,
    elapsed: Duration,
    stops: bool,
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
    /// Checks that all processes have the same model and images. `place` is the step, and the rays of the next one.
    pub fn new(
        mut exchange: Box<dyn Exchange>,
        model: &Model<f32>,
        data: &Dataset,
        place: (u64, usize),
    ) -> Result<Self> {
        let own = Start::new(model, data, place)?;
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
    pub fn gather(&mut self, own: &[f32]) -> Option<Vec<Vec<f32>>> {
        let mut bytes = vec![];
        f32::write_le(own, &mut bytes);
        match self.exchange.all_gather(&bytes) {
            Ok(all) => Some(all.iter().map(|bytes| f32::read_le(bytes)).collect()),
            Err(error) => {
                self.error = Some(error);
                None
            }
        }
    }

    /// Begins a step: returns the training time by the clock of rank 0, or `None` at the end of the run.
    pub fn begin(&mut self, step: u64, elapsed: Duration) -> Option<Duration> {
        if self.error.is_some() {
            return None;
        }
        let own = Turn { step, elapsed, stops: std::mem::take(&mut self.stops) };
        let turns = gather(&mut *self.exchange, &own).and_then(|turns| {
            match turns.iter().enumerate().find(|(_, turn)| turn.step != step) {
                Some((rank, turn)) => {
                    let what = format!("is at step {}, and this rank at step {step}", turn.step);
                    Err(ExchangeError::Differs { rank, what })
                }
                None => Ok(turns),
            }
        });
        match turns {
            Ok(turns) => (!turns.iter().any(|turn| turn.stops)).then_some(turns[0].elapsed),
            Err(error) => {
                self.error = Some(error);
                None
            }
        }
    }
}

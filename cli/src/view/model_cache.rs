//! Models to look at beside the one that a run ended with: as a checkpoint has it, and with more or less left out.

use std::sync::Arc;

use raygrad::nerf::space::occupancy::Skip;
use raygrad::nerf::{Model, Result};

use super::cache::{Cache, Cached};
use super::messages::View;
use super::requests::Requests;
use crate::checkpoint;
use crate::run::Run;

/// Models that are kept in memory.
const KEPT: usize = 3;

/// Which model is looked at: of which step, if it is a checkpoint's, and what it leaves out, if that is not as in training.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct ModelKey {
    pub checkpoint: Option<u64>,
    pub skip: Option<Skip>,
}

impl ModelKey {
    pub fn of(view: &View) -> Self {
        ModelKey { checkpoint: view.checkpoint, skip: view.skip }
    }
}

/// The models of a run.
pub struct ModelCache {
    run: Arc<Run>,
    model: Arc<Model<f32>>,
    others: Cache<ModelKey, Model<f32>>,
}

impl ModelCache {
    pub fn new(run: Arc<Run>, model: Arc<Model<f32>>) -> Self {
        ModelCache { run, model, others: Cache::new(KEPT) }
    }

    /// A model; wakes who waits at the requests when one that was not here has come.
    pub fn get(&self, which: ModelKey, requests: &Arc<Requests>) -> Cached<Model<f32>> {
        if which == ModelKey::default() {
            return Cached::Here(self.model.clone());
        }
        let (run, model, requests) = (self.run.clone(), self.model.clone(), requests.clone());
        self.others.get(which, move || made(&run, &model, which), move || requests.wake())
    }
}

fn made(run: &Run, model: &Model<f32>, ModelKey { checkpoint, skip }: ModelKey) -> Result<Model<f32>> {
    let mut model = match checkpoint {
        Some(step) => model.at_state(&checkpoint::read(run, step)?)?,
        None => model.clone(),
    };
    if let Some(skip) = skip {
        model.set_skip(skip);
    }
    Ok(model)
}

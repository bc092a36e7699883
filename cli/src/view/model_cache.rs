//! Models of checkpoints, and models with other skipping.

use std::sync::Arc;

use raygrad::nerf::space::occupancy::Skip;
use raygrad::nerf::{Model, Result};

use super::cache::{Cache, Cached};
use super::messages::View;
use super::requests::Requests;
use crate::checkpoint;
use crate::run::Run;

/// Number of models in memory.
const KEPT: usize = 3;

/// Identifies a model: the step of its checkpoint, and its skipping, if it differs from training.
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

    /// Returns a model. Notifies `requests` when a model that was not cached is ready.
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

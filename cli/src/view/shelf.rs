//! Models to look at beside the one that a run ended with: as a checkpoint has it, and with more or less left out.

use std::sync::Arc;

use raygrad::nerf::space::occupancy::Skip;
use raygrad::nerf::{Model, Result};

use super::hub::Hub;
use super::messages::View;
use super::store::{Got, Store};
use crate::checkpoint;
use crate::run::Run;

/// Models that are kept in memory.
const KEPT: usize = 3;

/// Which model is looked at: of which step, if it is a checkpoint's, and what it leaves out, if that is not as in training.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Which {
    pub checkpoint: Option<u64>,
    pub skip: Option<Skip>,
}

impl Which {
    pub fn of(view: &View) -> Self {
        Which { checkpoint: view.checkpoint, skip: view.skip }
    }
}

/// The models of a run.
pub struct Shelf {
    run: Arc<Run>,
    model: Arc<Model<f32>>,
    others: Store<Which, Model<f32>>,
}

impl Shelf {
    pub fn new(run: Arc<Run>, model: Arc<Model<f32>>) -> Self {
        Shelf { run, model, others: Store::new(KEPT) }
    }

    /// A model; wakes who waits at the hub when one that was not here has come.
    pub fn get(&self, which: Which, hub: &Arc<Hub>) -> Got<Model<f32>> {
        if which == Which::default() {
            return Got::Here(self.model.clone());
        }
        let (run, model, hub) = (self.run.clone(), self.model.clone(), hub.clone());
        self.others.get(which, move || made(&run, &model, which), move || hub.wake())
    }
}

fn made(run: &Run, model: &Model<f32>, Which { checkpoint, skip }: Which) -> Result<Model<f32>> {
    let mut model = match checkpoint {
        Some(step) => model.at_state(&checkpoint::read(run, step)?)?,
        None => model.clone(),
    };
    if let Some(skip) = skip {
        model.set_skip(skip);
    }
    Ok(model)
}

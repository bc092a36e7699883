//! A medium as a field.

use super::Medium;
use crate::field::{Density, Field, ViewInputs};
use raygrad_autograd::{Scalar, Tensor, Var};
use raygrad_nn::{Bound, ParamId, Params};
use std::sync::Arc;

/// A medium as a field. Its amplitudes are a trainable parameter; positions have no gradient.
#[derive(Debug, Clone)]
pub struct AnalyticField {
    medium: Arc<dyn Medium>,
    amplitudes: ParamId,
}

impl AnalyticField {
    /// Creates a field with one parameter, `amplitudes` `[amplitudes]`, in `params`.
    pub fn new<T: Scalar>(medium: Arc<dyn Medium>, params: &mut Params<T>) -> Self {
        let values: Vec<T> = medium.amplitudes().into_iter().map(T::from_f64).collect();
        let amplitudes = params.add("amplitudes", Tensor::from_vec(&[values.len()], values));
        AnalyticField { medium, amplitudes }
    }
}

/// The rows of a tensor as positions.
fn rows<T: Scalar>(x: &Tensor<T>) -> impl Iterator<Item = [f64; 3]> + '_ {
    x.as_slice().chunks_exact(3).map(|x| [x[0], x[1], x[2]].map(T::to_f64))
}

impl<T: Scalar> Field<T> for AnalyticField {
    fn density<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T> {
        let amplitudes = &params[self.amplitudes];
        let (samples, count) = (positions.shape()[0], amplitudes.shape()[0]);
        let mut shapes = vec![0.0; samples * count];
        for (position, out) in rows(positions.value()).zip(shapes.chunks_exact_mut(count)) {
            self.medium.shapes(position, out);
        }
        let shapes = Tensor::from_vec(&[samples, count], shapes.into_iter().map(T::from_f64).collect());
        let value = (amplitudes * shapes).sum_over(1);
        Density { value, log: false, features: positions.clone() }
    }

    fn color<'t>(&self, _: &Bound<'t, T>, features: &Var<'t, T>, _: &ViewInputs<'_, 't, T>) -> Var<'t, T> {
        let colors = rows(features.value()).flat_map(|position| [T::from_f64(self.medium.color(position)); 3]);
        features.tape().constant(Tensor::from_vec(features.shape(), colors.collect()))
    }
}

//! Embeddings.

use super::Init;
use crate::{Bound, ParamId, Params};
use rand::Rng;
use raygrad_autograd::Var;
use raygrad_tensor::{Indices, Scalar};

/// An embedding: a table with one learned vector for each of many items, such as words, images or places.
///
/// The gradient of the table is sparse: it has the rows that were used ([`RowGrad`](raygrad_autograd::RowGrad)). With
/// [`Params::set_lazy`] the optimizer reads and updates only these rows. Otherwise it treats the table as any other
/// parameter, with a gradient that is mostly 0.
///
/// ```
/// use raygrad_autograd::Tape;
/// use raygrad_nn::{Adam, AdamConfig, Embedding, Init, Optimizer, Params};
/// use rand::SeedableRng;
/// let mut rng = rand::rngs::StdRng::seed_from_u64(1);
/// let mut params = Params::<f32>::new();
/// let words = Embedding::new(&mut params, "words", [1000, 8], Init::Normal(0.1), &mut rng);
/// params.set_lazy(|name| name == "words.weight", true);
/// let mut adam = Adam::new(AdamConfig::default());
///
/// let tape = Tape::new();
/// let bound = params.bind(&tape);
/// let vectors = words.forward(&bound, [17, 4, 17]);
/// assert_eq!(vectors.shape(), [3, 8]);
/// let grads = bound.backward(&vectors.square().sum());
/// let report = adam.update(&mut params, &grads, 1e-3);
/// assert_eq!(report.updated, 2 * 8);
/// ```
#[derive(Debug, Clone, Copy)]
pub struct Embedding {
    table: ParamId,
}

impl Embedding {
    /// A table of `rows` vectors of length `width`, with the parameter `<name>.weight`.
    pub fn new<T: Scalar>(
        params: &mut Params<T>,
        name: &str,
        [rows, width]: [usize; 2],
        init: Init,
        rng: &mut (impl Rng + ?Sized),
    ) -> Self {
        Embedding { table: params.add(format!("{name}.weight"), init.weight(rows, width, rng)) }
    }

    /// The handle of the table's parameter.
    pub fn table(&self) -> ParamId {
        self.table
    }

    /// Looks up the vectors of these rows: `[index.len(), width]`. The indices are an array, a vector, a slice, a
    /// shared slice (`Arc<[u32]>`, without a copy) or [`Indices`] of one axis.
    ///
    /// # Panics
    /// If an index is not below the number of rows, or the indices have not exactly one axis.
    #[track_caller]
    pub fn forward<'t, T: Scalar>(&self, params: &Bound<'t, T>, index: impl Into<Indices>) -> Var<'t, T> {
        params[self.table].gather_rows(index)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use raygrad_autograd::check::{Check, check_function};
    use raygrad_autograd::{Tape, Tensor};
    use std::sync::Arc;

    #[test]
    fn a_table_is_learned_through_dense_gradients_too() {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(1);
        let mut params = Params::<f64>::new();
        let layer = Embedding::new(&mut params, "words", [5, 3], Init::Uniform(1.0), &mut rng);
        assert_eq!(params.iter().map(|(name, _)| name).collect::<Vec<_>>(), ["words.weight"]);
        let table = params.values()[0].clone();
        check_function(&Check::default(), std::slice::from_ref(&table), |x| {
            layer.forward(&params.layout().bind(x.to_vec()), [4, 1, 4]).exp()
        })
        .unwrap();
        let tape = Tape::new();
        let bound = params.bind(&tape);
        let y = layer.forward(&bound, [4, 1]);
        assert_eq!(y.value().as_slice(), [&table.as_slice()[12..15], &table.as_slice()[3..6]].concat());
        let (list, shared) = (vec![4, 1], Arc::from([4, 1]));
        for again in [
            layer.forward(&bound, &list[..]),
            layer.forward(&bound, &list),
            layer.forward(&bound, &shared),
            layer.forward(&bound, Indices::from(&shared)),
            layer.forward(&bound, shared),
            layer.forward(&bound, list),
        ] {
            assert_eq!(again.value(), y.value());
        }
        let error = tape.try_run(|| layer.forward(&bound, Indices::new(&[1, 2], [4, 1])).into_value()).unwrap_err();
        assert!(error.to_string().contains("indices of shape [1, 2] are no list"), "{error}");
        assert_eq!(layer.forward(&bound, []).shape(), [0, 3]);
        assert_eq!(layer.forward(&bound, []).sum().grad(&bound.vars())[0], Tensor::zeros(&[5, 3]));
    }
}
